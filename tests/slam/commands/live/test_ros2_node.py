"""The ROS 2 node on a simulated street. rclpy is on no package index: its calls are recorded here, and messages have
the fields that rosbags knows of them."""

from __future__ import annotations

import copy
import importlib.util
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest

from slam import Slam
from slam.config.sections import load_config
from slam.formats.trajectory import read_trajectory
from slam.sequences.catalogue import open_sequence

pytest.importorskip("rosbags")

from rosbags.typesys import Stores, get_typestore

NODE = Path(__file__).parents[4] / "tools" / "ros2" / "slam_node.py"
STORE = get_typestore(Stores.ROS2_HUMBLE)
FRAMES, FIRST_S = 12, 1_700_000_000
MESSAGES = {
    "geometry_msgs": ("Point", "Pose", "PoseStamped", "Quaternion", "Transform", "TransformStamped", "Vector3"),
    "nav_msgs": ("Path",),
    "sensor_msgs": ("CameraInfo", "Image"),
    "std_msgs": ("Header",),
    "builtin_interfaces": ("Time",),
}


class RecordedNode:
    """rclpy's ``Node``: parameters and remapped topics are those of the class, what is said is kept."""

    parameters: ClassVar[dict[str, Any]] = {}
    topics: ClassVar[dict[str, str]] = {}

    def __init__(self, name: str) -> None:
        self.name = name
        self.logged: list[str] = []
        self.published: dict[str, list[Any]] = {}
        self.callbacks: dict[str, Callable[[Any], None]] = {}

    def declare_parameter(self, name: str, value: Any) -> SimpleNamespace:
        return SimpleNamespace(value=self.parameters.get(name, value))

    def resolve_topic_name(self, topic: str) -> str:
        return self.topics.get(topic, f"/{topic}")

    def create_publisher(self, kind: type, topic: str, depth: int) -> SimpleNamespace:
        return SimpleNamespace(publish=self._keeper(kind, topic))

    def create_subscription(self, kind: type, topic: str, callback: Callable[[Any], None], qos: Any) -> None:
        self.callbacks[topic] = callback

    def get_logger(self) -> SimpleNamespace:
        keep = lambda text, **_: self.logged.append(text)  # noqa: E731
        return SimpleNamespace(warning=keep, error=keep)

    def _keeper(self, kind: type, topic: str) -> Callable[[Any], None]:
        def keep(message: Any) -> None:
            assert isinstance(message, kind)
            STORE.serialize_cdr(message, kind.__msgtype__)  # refuses fields of other types
            self.published.setdefault(topic, []).append(copy.deepcopy(message))

        return keep


class Broadcaster:
    """tf2's ``TransformBroadcaster``."""

    def __init__(self, node: RecordedNode) -> None:
        self.sendTransform = node._keeper(STORE.types["geometry_msgs/msg/TransformStamped"], "tf")


class RosTime(SimpleNamespace):
    """rclpy's ``Time``."""

    def to_msg(self) -> Any:
        seconds, nanoseconds = divmod(self.nanoseconds, 10**9)
        return STORE.types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)


@pytest.fixture
def node_module(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    def module(name: str, **content: Any) -> None:
        made = ModuleType(name)
        vars(made).update(content)
        monkeypatch.setitem(sys.modules, name, made)

    for package, kinds in MESSAGES.items():
        module(package)
        module(f"{package}.msg", **{kind: STORE.types[f"{package}/msg/{kind}"] for kind in kinds})
    module("rclpy")
    module("rclpy.executors", ExternalShutdownException=Exception)
    module("rclpy.node", Node=RecordedNode)
    module("rclpy.qos", QoSProfile=SimpleNamespace, QoSReliabilityPolicy=SimpleNamespace(BEST_EFFORT="best effort"))
    module("rclpy.time", Time=RosTime)
    module("tf2_ros", TransformBroadcaster=Broadcaster)
    spec = importlib.util.spec_from_file_location("slam_node", NODE)
    assert spec is not None and spec.loader is not None
    loaded = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(loaded)
    return loaded


def header(number: int) -> Any:
    stamp = STORE.types["builtin_interfaces/msg/Time"](sec=FIRST_S + number // 10, nanosec=number % 10 * 10**8)
    return STORE.types["std_msgs/msg/Header"](stamp=stamp, frame_id="front_optical")


def image_message(image: np.ndarray, number: int) -> Any:
    height, width = image.shape[:2]
    made = STORE.types["sensor_msgs/msg/Image"]
    return made(header(number), height, width, "rgb8", 0, 3 * width, image.reshape(-1))


def info_message(K: np.ndarray, width: int, height: int) -> Any:
    made = STORE.types["sensor_msgs/msg/CameraInfo"]
    region = STORE.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    P = np.column_stack([K, np.zeros(3)]).ravel()
    return made(header(0), height, width, "plumb_bob", np.zeros(5), K.ravel(), np.eye(3).ravel(), P, 0, 0, region)


def test_the_node_publishes_what_slam_finds(
    node_module: ModuleType, kitti_root: Path, tiny_weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drive = open_sequence(kitti_root)
    intrinsics, images = drive.intrinsics, [drive.frame(k).image for k in range(FRAMES)]
    written = tmp_path / "walk.txt"
    asked = {"weights": str(tiny_weights), "camera_height_m": 1.65, "settings": "loops.enabled=false"}
    monkeypatch.setattr(RecordedNode, "parameters", asked | {"trajectory": str(written), "path_every": 5})
    node = node_module.SlamNode()
    add, begin = node.callbacks["image"], node.callbacks["camera_info"]
    add(image_message(images[0], 0))
    assert node.logged == ["no camera_info yet: images are left out"] and not node.published
    begin(info_message(intrinsics.K, intrinsics.width, intrinsics.height))
    for number, image in enumerate(images):
        add(image_message(image, number))
    add(image_message(images[-1][:-1], FRAMES))  # of another size
    add(image_message(images[-1], FRAMES - 1))  # of the same time
    assert len(node.logged) == 3 and "image must be" in node.logged[1] and "stamps must increase" in node.logged[2]
    node.finish()

    config = load_config(None, ["loops.enabled=false"])
    with Slam.from_weights(tiny_weights, intrinsics, config, 1.65) as slam:
        expected = []
        for number, image in enumerate(images):
            slam.add_frame(image, FIRST_S + number // 10 + 1e-9 * (number % 10 * 10**8))
            expected.append(slam.trajectory())
        slam.close_loops()
        solved = slam.trajectory()
    poses, paths, transforms = (node.published[topic] for topic in ("pose", "path", "tf"))
    assert [len(path.poses) for path in paths] == [5, 10]
    for number, (pose, transform) in enumerate(zip(poses, transforms, strict=True)):
        x, y, z = expected[number].positions[-1]
        at = pose.pose.position
        np.testing.assert_allclose([at.x, at.y, at.z], [z, -x, -y], atol=1e-12)
        moved, turned = transform.transform.translation, transform.transform.rotation
        assert (moved.x, moved.y, moved.z) == (at.x, at.y, at.z) and turned == pose.pose.orientation
        assert pose.header == transform.header and pose.header.frame_id == "map"
        assert pose.header.stamp == header(number).stamp and transform.child_frame_id == "front_optical"
    first = poses[0].pose.orientation  # z of the camera ahead, along x of the map
    np.testing.assert_allclose([first.x, first.y, first.z, first.w], [-0.5, 0.5, -0.5, 0.5])
    last = paths[-1].poses[-1].pose.position
    np.testing.assert_allclose([-last.y, -last.z, last.x], expected[9].positions[-1], atol=1e-12)
    assert poses[-1].pose.position.x > 1.0
    np.testing.assert_allclose(read_trajectory(written).positions, solved.positions, atol=1e-6)


def test_a_distorted_camera_and_one_that_is_rectified(
    node_module: ModuleType, kitti_root: Path, tiny_weights: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drive = open_sequence(kitti_root)
    intrinsics, image = drive.intrinsics, drive.frame(0).image
    monkeypatch.setattr(RecordedNode, "parameters", {"weights": str(tiny_weights), "publish_tf": False})
    seen, add_frame = [], Slam.add_frame

    def watched(slam: Slam, image: np.ndarray, stamp: float) -> None:
        seen.append(image)
        add_frame(slam, image, stamp)

    monkeypatch.setattr(Slam, "add_frame", watched)
    for topic in ("/front/image_raw", "/front/image_rect"):
        monkeypatch.setattr(RecordedNode, "topics", {"image": topic})
        node = node_module.SlamNode()
        info = info_message(intrinsics.K, intrinsics.width, intrinsics.height)
        info.d = np.array([-0.1, 0.01, 0.0, 0.0, 0.0])
        node.callbacks["camera_info"](info)
        node.callbacks["image"](image_message(image, 0))
        assert len(node.published["pose"]) == 1 and "tf" not in node.published
    bent, straight = seen
    assert bent.shape == straight.shape and not np.array_equal(bent, image)
    np.testing.assert_array_equal(straight, image)
