"""The ROS 2 node on a simulated street. rclpy is no dependency: its calls are recorded here, and messages have the
fields that rosbags knows of them."""

from __future__ import annotations

import copy
import importlib.util
import sys
from array import array
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest

from slam import Slam
from slam.config.sections import load_config
from slam.formats.trajectory import read_trajectory
from slam.frames import Intrinsics
from slam.geometry.se3 import FloatArray, invert
from slam.sequences.catalogue import open_sequence

pytest.importorskip("rosbags")

from rosbags.typesys import Stores, get_typestore

NODE = Path(__file__).parents[3] / "tools" / "ros2" / "slam_node.py"
STORE = get_typestore(Stores.ROS2_HUMBLE)
FRAMES, FIRST_S = 12, 1_700_000_000
MESSAGES = {
    "geometry_msgs": "Point Pose PoseStamped Quaternion Transform TransformStamped Vector3",
    "nav_msgs": "MapMetaData OccupancyGrid Path",
    "sensor_msgs": "CameraInfo Image PointCloud2 PointField",
    "std_msgs": "Header",
    "builtin_interfaces": "Time",
}
QOS = {
    "QoSProfile": SimpleNamespace,
    "QoSReliabilityPolicy": SimpleNamespace(BEST_EFFORT="best effort"),
    "QoSDurabilityPolicy": SimpleNamespace(TRANSIENT_LOCAL="transient local"),
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
        self.services: dict[str, Callable[[Any, Any], Any]] = {}

    def declare_parameter(self, name: str, value: Any, descriptor: Any) -> SimpleNamespace:
        return SimpleNamespace(value=self.parameters.get(name, value))

    def resolve_topic_name(self, topic: str) -> str:
        return self.topics.get(topic, f"/{topic}")

    def create_publisher(self, kind: type, topic: str, qos: Any) -> SimpleNamespace:
        return SimpleNamespace(publish=self._keeper(kind, topic))

    def create_subscription(
        self, kind: type, topic: str, callback: Callable[[Any], None], qos: Any
    ) -> None:
        self.callbacks[topic] = callback

    def create_service(self, kind: type, name: str, callback: Callable[[Any, Any], Any]) -> None:
        self.services[name] = callback

    def get_clock(self) -> SimpleNamespace:
        return SimpleNamespace(now=lambda: RosTime(nanoseconds=10**9 * FIRST_S))

    def get_logger(self) -> SimpleNamespace:
        keep = lambda text, **_: self.logged.append(text)  # noqa: E731
        return SimpleNamespace(warning=keep, error=keep)

    def _keeper(self, kind: type, topic: str) -> Callable[[Any], None]:
        def keep(message: Any) -> None:
            assert isinstance(message, kind)
            if isinstance(getattr(message, "data", None), array):  # as rclpy wants it
                message.data = np.array(message.data)
            STORE.serialize_cdr(message, kind.__msgtype__)  # refuses fields of other types
            self.published.setdefault(topic, []).append(copy.deepcopy(message))

        return keep


class Broadcaster:
    """tf2's ``TransformBroadcaster``."""

    def __init__(self, node: RecordedNode) -> None:
        self.sendTransform = node._keeper(STORE.types["geometry_msgs/msg/TransformStamped"], "tf")


class Unknown(Exception):
    """tf2's ``TransformException``."""


class Buffer:
    """tf2's ``Buffer``, which knows the transforms of the class."""

    known: ClassVar[dict[tuple[str, str], Any]] = {}

    def lookup_transform(self, target: str, source: str, time: Any) -> SimpleNamespace:
        if (target, source) not in self.known:
            raise Unknown(f"{target} is unknown")
        return SimpleNamespace(transform=self.known[target, source])


class RosTime(SimpleNamespace):
    """rclpy's ``Time``."""

    @classmethod
    def from_msg(cls, message: Any) -> RosTime:
        return cls(nanoseconds=message.sec * 10**9 + message.nanosec)

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
        module(
            f"{package}.msg",
            **{kind: STORE.types[f"{package}/msg/{kind}"] for kind in kinds.split()},
        )
    module("rcl_interfaces")
    module("rcl_interfaces.msg", ParameterDescriptor=SimpleNamespace)
    module("rclpy")
    module("rclpy.executors", ExternalShutdownException=Exception, MultiThreadedExecutor=None)
    module("rclpy.node", Node=RecordedNode)
    module("rclpy.qos", **QOS)
    module("rclpy.time", Time=RosTime)
    listener = {
        "Buffer": Buffer,
        "TransformListener": lambda *_: None,
        "TransformException": Unknown,
    }
    module("tf2_ros", TransformBroadcaster=Broadcaster, **listener)
    module("std_srvs")
    module(
        "std_srvs.srv", Trigger=SimpleNamespace(Request=SimpleNamespace, Response=SimpleNamespace)
    )
    monkeypatch.syspath_prepend(str(NODE.parent))
    return loaded(NODE)


def loaded(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def header(number: int) -> Any:
    stamp = STORE.types["builtin_interfaces/msg/Time"](
        sec=FIRST_S + number // 10, nanosec=number % 10 * 10**8
    )
    return STORE.types["std_msgs/msg/Header"](stamp=stamp, frame_id="front_optical")


def image_message(image: np.ndarray, number: int) -> Any:
    height, width = image.shape[:2]
    made = STORE.types["sensor_msgs/msg/Image"]
    return made(header(number), height, width, "rgb8", 0, 3 * width, image.reshape(-1))


def info_message(camera: Intrinsics) -> Any:
    K, made = camera.K, STORE.types["sensor_msgs/msg/CameraInfo"]
    region = STORE.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    P = np.column_stack([K, np.zeros(3)]).ravel()
    lens, straight = ("plumb_bob", np.zeros(5), K.ravel()), np.eye(3).ravel()
    return made(header(0), camera.height, camera.width, *lens, straight, P, 0, 0, region)


def test_the_node_publishes_what_slam_finds(
    node_module: ModuleType,
    kitti_root: Path,
    tiny_weights: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
):
    drive = open_sequence(kitti_root)
    intrinsics, images = drive.intrinsics, [drive.frame(k).image for k in range(FRAMES)]
    written = tmp_path / "walk.txt"
    asked = {
        "weights": str(tiny_weights),
        "camera_height_m": 1.65,
        "settings": "loops.enabled=false",
    }
    monkeypatch.setattr(
        RecordedNode, "parameters", asked | {"trajectory": str(written), "path_every": 5}
    )
    node = node_module.SlamNode()
    add, begin = node.callbacks["image"], node.callbacks["camera_info"]
    add(image_message(images[0], 0))
    assert node.logged == ["no camera_info yet: images are left out"] and not node.published
    begin(info_message(intrinsics))
    for number, image in enumerate(images):
        add(image_message(image, number))
    add(image_message(images[-1][:-1], FRAMES))  # of another size
    add(image_message(images[-1], FRAMES - 1))  # of the same time
    assert (
        len(node.logged) == 3
        and "image must be" in node.logged[1]
        and "stamps must increase" in node.logged[2]
    )
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
    for number, (pose, in_odom, in_map) in enumerate(
        zip(poses, transforms[::2], transforms[1::2], strict=True)
    ):
        x, y, z = expected[number].positions[-1]
        at = pose.pose.position
        np.testing.assert_allclose([at.x, at.y, at.z], [z, -x, -y], atol=1e-12)
        assert (in_map.header.frame_id, in_map.child_frame_id) == ("map", "odom")
        assert (in_odom.header.frame_id, in_odom.child_frame_id) == ("odom", "front_optical")
        T_map_camera = matrix(node_module, in_map) @ matrix(node_module, in_odom)
        np.testing.assert_allclose(T_map_camera[:3, 3], [at.x, at.y, at.z], atol=1e-12)
        assert (
            pose.header == in_map.header
            and pose.header.stamp == in_odom.header.stamp == header(number).stamp
        )
    first = poses[0].pose.orientation  # z of the camera ahead, along x of the map
    np.testing.assert_allclose([first.x, first.y, first.z, first.w], [-0.5, 0.5, -0.5, 0.5])
    last = paths[-1].poses[-1].pose.position
    np.testing.assert_allclose([-last.y, -last.z, last.x], expected[9].positions[-1], atol=1e-12)
    assert poses[-1].pose.position.x > 1.0
    np.testing.assert_allclose(read_trajectory(written).positions, solved.positions, atol=1e-6)


def matrix(node_module: ModuleType, message: Any) -> FloatArray:
    found: FloatArray = node_module.matrix_of(message.transform)
    return found


@pytest.mark.slow
def test_loops_move_the_map_and_not_the_odometry(
    node_module: ModuleType, kitti_root: Path, monkeypatch: pytest.MonkeyPatch
):
    drive = open_sequence(kitti_root)
    images = [image_message(drive.frame(k).image, k) for k in range(FRAMES)]
    of_base = {"base_frame": "base_link", "map_every": 12, "keyframe_spacing": 0.5, "depth_to": 30}
    asked = {"weights": "sim", "camera_height_m": 1.65, **of_base}
    monkeypatch.setattr(RecordedNode, "parameters", asked)
    T_base_camera = node_module.T_MAP_WORLD.copy()
    T_base_camera[:3, 3] = 0.2, 0.0, 1.65
    node = node_module.SlamNode()
    assert not node.services["close_loops"](None, SimpleNamespace()).success
    add, begin = node.callbacks["image"], node.callbacks["camera_info"]
    begin(info_message(drive.intrinsics))
    add(images[0])
    assert node.logged == ["no transform from base_link to the camera yet: images are left out"]
    placed = node_module.transform_of(T_base_camera, header(0), "front_optical").transform
    monkeypatch.setattr(Buffer, "known", {("base_link", "front_optical"): placed})
    for image in images[:10]:
        add(image)
    assert node.services["close_loops"](None, SimpleNamespace()).success
    for image in images[10:]:
        add(image)
    odom = np.array([matrix(node_module, each) for each in node.published["tf"][::2]])
    in_map = np.array([matrix(node_module, each) for each in node.published["tf"][1::2]])
    np.testing.assert_allclose(
        in_map[0] @ odom[0], np.eye(4), atol=1e-9
    )  # the map begins at the robot
    steps = np.linalg.norm(np.diff(odom[:, :3, 3], axis=0), axis=1)
    moved = np.linalg.norm(np.diff((in_map @ odom)[:, :3, 3], axis=0), axis=1)
    assert steps.max() < 1.5 < moved.max(), "the first unit moves the map, and odom goes on"
    clouds, points, grids = (
        node.published[topic] for topic in ("keyframe_points", "map_points", "map")
    )
    assert clouds and {each.header.frame_id for each in clouds} == {"front_optical"}
    assert len(points) == 2 and points[-1].header.frame_id == "map", (
        "by the service and after 12 frames"
    )
    assert [each.info.width * each.info.height for each in grids] == [
        len(each.data) for each in grids
    ]
    monkeypatch.setattr(RecordedNode, "parameters", asked | {"publish_tf": "map_to_odom"})
    monkeypatch.setitem(Buffer.known, ("odom", "base_link"), placed)
    of_robot = node_module.SlamNode()
    of_robot.callbacks["camera_info"](info_message(drive.intrinsics))
    of_robot.callbacks["image"](images[0])
    (only,) = of_robot.published["tf"]
    assert only.child_frame_id == "odom"
    np.testing.assert_allclose(matrix(node_module, only), invert(T_base_camera), atol=1e-9)


def test_an_occupancy_grid_follows_its_keyframes(node_module: ModuleType):
    """A wall 6 m ahead of two keyframes; the second one is moved by a loop."""
    from live_map import LiveMap

    side, ahead = (
        each.ravel() for each in np.meshgrid(np.arange(-3, 3, 0.1), np.arange(1, 6, 0.1))
    )
    across, up = (
        each.ravel() for each in np.meshgrid(np.arange(-3, 3, 0.1), np.arange(-1, 1, 0.1))
    )
    road = np.column_stack([side, np.full(len(side), 1.65), ahead])
    cloud = np.concatenate([road, np.column_stack([across, up, np.full(len(up), 6.2)])])
    T_map_camera = np.array([node_module.T_MAP_WORLD] * 2)
    T_map_camera[1, 0, 3] = 1.0
    live_map = LiveMap(resolution=0.5, spacing=0.5, depth_to=8.0)
    assert live_map.add({0: cloud, 1: cloud}, T_map_camera) == [0, 1]
    for moved in (0.0, 20.0):
        T_map_camera[1, 0, 3] = 1.0 + moved
        cells, grid = live_map.grid(T_map_camera, 1.65, 1.0)
        row = cells[cells.shape[0] // 2]
        walls = {float(grid.corner[0] + 0.5 * k): int(row[k]) for k in np.flatnonzero(row > 0)}
        assert walls == ({6.0: 100, 27.0: 100} if moved else {6.0: 50, 7.0: 100}), (
            "the second sees road at 6 m"
        )
        assert (row == 0).sum() >= 8 and len(live_map.points(T_map_camera)) > 100


def test_the_launch_file_gives_every_parameter(
    monkeypatch: pytest.MonkeyPatch, node_module: ModuleType
):
    launch = SimpleNamespace(
        LaunchDescription=list,
        LaunchConfiguration=str,
        DeclareLaunchArgument=lambda name, default_value: name,
        ExecuteProcess=lambda cmd, output: cmd,
    )
    for name in ("launch", "launch.substitutions", "launch.actions"):
        monkeypatch.setitem(sys.modules, name, launch)
    launch = loaded(NODE.with_name("slam.launch.py"))
    *arguments, command = launch.generate_launch_description()
    assert set(arguments) == set(node_module.PARAMETERS) | {"image", "camera_info", "map"}
    given = ["".join(part) for part in command if isinstance(part, list)]
    assert "settings:='settings'" in given and "camera_height_m:=camera_height_m" in given


def test_a_distorted_camera_and_one_that_is_rectified(
    node_module: ModuleType, kitti_root: Path, tiny_weights: Path, monkeypatch: pytest.MonkeyPatch
):
    drive = open_sequence(kitti_root)
    intrinsics, image = drive.intrinsics, drive.frame(0).image
    monkeypatch.setattr(
        RecordedNode, "parameters", {"weights": str(tiny_weights), "publish_tf": "none"}
    )
    seen, add_frame = [], Slam.add_frame

    def watched(slam: Slam, image: np.ndarray, stamp: float) -> None:
        seen.append(image)
        add_frame(slam, image, stamp)

    monkeypatch.setattr(Slam, "add_frame", watched)
    for topic in ("/front/image_raw", "/front/image_rect"):
        monkeypatch.setattr(RecordedNode, "topics", {"image": topic})
        node = node_module.SlamNode()
        info = info_message(intrinsics)
        info.d = np.array([-0.1, 0.01, 0.0, 0.0, 0.0])
        node.callbacks["camera_info"](info)
        node.callbacks["image"](image_message(image, 0))
        assert len(node.published["pose"]) == 1 and "tf" not in node.published
    bent, straight = seen
    assert bent.shape == straight.shape and not np.array_equal(bent, image)
    np.testing.assert_array_equal(straight, image)
