"""Bags of ROS 1 and ROS 2: images, calibration, stamps, true poses and scans; several cameras; damage."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from bags import BagWriter

from slam.commands.doctor import examine
from slam.frames import Intrinsics
from slam.runtime import imports
from slam.runtime.errors import SequenceError, SlamError
from slam.sequences.catalogue import open_sequence, sequence_kinds

CAMERA = Intrinsics(40, 24, 30, 30, 20, 12)
FIRST_NS, STEP_NS, FRAMES = 1403715273262142976, 50_000_000, 6
NewBag = Callable[..., Any]
CHANNELS = {
    "rgb8": 3,
    "bgra8": 4,
    "8UC3": 3,
    "yuv422": 2,
    "yuv422_yuy2": 2,
    "mono16": 1,
    "16UC1": 1,
}
COMPARED_FRAMES, COMPARED_STEP_NS = 8, 100_000_000


def picture(k: int, channels: int = 1) -> np.ndarray:
    shape = (24, 40) if channels == 1 else (24, 40, channels)
    return np.random.default_rng(k).integers(0, 255, shape, dtype=np.uint8)


def drive(bag: Any, topic: str = "/cam0/image_raw", encoding: str = "mono8") -> None:
    """Six images whose stamps go backwards in the bag: the first two are recorded in the other order."""
    bag.camera_info(f"{topic.rpartition('/')[0]}/camera_info", CAMERA, "plumb_bob", (0.0,) * 5)
    for k in range(FRAMES):
        bag.image(
            topic,
            FIRST_NS + k * STEP_NS,
            picture(k),
            encoding,
            late_ns=2 * STEP_NS if k == 0 else 0,
        )


def test_opens(new_bag: NewBag, kind: str):
    bag = new_bag(kind)
    drive(bag)
    path = bag.close()
    sequence = open_sequence(path)
    assert (sequence.name, len(sequence), sequence.intrinsics) == ("walk", FRAMES, CAMERA)
    assert sequence.stamps.tolist() == [(FIRST_NS + k * STEP_NS) / 10**9 for k in range(FRAMES)]
    assert sequence.provenance() == ("bag/walk[0:6]",) and sequence.reference is None
    for k in (0, 1, 5, 2, 3, 0):
        assert np.array_equal(sequence.frame(k).image, np.repeat(picture(k)[:, :, None], 3, axis=2))
    assert list(sequence_kinds(path)) == ["/cam0/image_raw"]
    if path.is_dir():
        (file,) = (file for file in path.iterdir() if file.suffix in (".db3", ".mcap"))
        assert open_sequence(file).stamps.tolist() == sequence.stamps.tolist()
    line = examine(path)[-1]
    assert line.startswith(
        "ok       sequence /cam0/image_raw: 6 frames of 40x24"
    ) and line.endswith("(ROS bag)")
    assert open_sequence(path.parent, frames="1:3").name == "walk"


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_compressed_images(new_bag: NewBag, kind: str, suffix: str):
    bag = new_bag(kind)
    bag.camera_info("/camera/camera_info", CAMERA, "plumb_bob", (0.0,) * 5)
    data = cv2.imencode(suffix, picture(1, 3))[1].ravel()
    message = bag.make(
        "sensor_msgs/msg/CompressedImage", header=bag.header(FIRST_NS, "c"), format="x", data=data
    )
    bag.write("/camera/image_raw/compressed", FIRST_NS, message)
    expected = cv2.imdecode(data, cv2.IMREAD_COLOR)[:, :, ::-1]
    assert np.array_equal(open_sequence(bag.close()).frame(0).image, expected)


@pytest.mark.parametrize(("encoding", "channels"), CHANNELS.items())
def test_encodings_of_a_grey_picture(new_bag: NewBag, encoding: str, channels: int):
    """Channels of equal value are grey in every encoding; of YUV 4:2:2 those with chroma 128."""
    level = 90
    pixels = np.full((24, 40, channels), level, np.uint8)
    if channels == 2:
        pixels[:, :, 0 if encoding == "yuv422" else 1] = 128
    elif encoding in ("mono16", "16UC1"):
        pixels = np.full((24, 40), level * 256 + 7, np.uint16)
    bag = new_bag()
    bag.camera_info("/c/camera_info", CAMERA, "", ())
    bag.image("/c/image", FIRST_NS, pixels, encoding)
    image = open_sequence(bag.close()).frame(0).image
    assert image.shape == (24, 40, 3) and np.ptp(image) == 0
    assert image[0, 0, 0] == pytest.approx(level, abs=16)  # video levels of YUV are stretched


def test_calibration(new_bag: NewBag, kind: str):
    bag = new_bag(kind)
    drive(bag, "/raw/image_raw")
    drive(bag, "/flat/image_rect")
    bag.camera_info("/bent/camera_info", CAMERA, "equidistant", (-0.05, 0.01, 0.0, 0.0))
    bag.image("/bent/image_raw", FIRST_NS, picture(0), "mono8")
    bag.camera_info("/odd/camera_info", CAMERA, "spiral", (1.0,))
    bag.image("/odd/image_raw", FIRST_NS, picture(0), "mono8")
    bag.image("/bare/image_raw", FIRST_NS, picture(0), "mono8")
    path = bag.close()
    assert open_sequence(path, "/raw/image_raw").intrinsics.fx == 30
    assert open_sequence(path, "/flat/image_rect").intrinsics.fx == 31  # P of rectified images
    assert open_sequence(path, "/bent/image_raw").intrinsics.fx not in (30, 31)
    with pytest.raises(SequenceError, match=r"spiral is unknown: known are .*give --camera"):
        open_sequence(path, "/odd/image_raw")
    with pytest.raises(
        SequenceError, match=r"no /bare/camera_info for /bare/image_raw .*give --camera"
    ):
        open_sequence(path, "/bare/image_raw")
    assert open_sequence(path, "/bare/image_raw", Path("fov=90")).intrinsics.fx == pytest.approx(20)


def test_images_are_a_binned_region_of_the_calibrated_sensor(new_bag: NewBag, kind: str):
    """A sensor of 87x60 with its calibration; the images show 80x48 of it, binned to 40x24."""
    sensor = Intrinsics(87, 60, 60, 60, 44.5, 31.5)
    bag = new_bag(kind)
    bag.camera_info("/part/camera_info", sensor, "plumb_bob", (), 2, (4, 7, 81, 48))
    bag.camera_info(
        "/all/camera_info", replace(sensor, width=40, height=24, cx=20, cy=12), "plumb_bob", (), 2
    )
    for topic in ("/part/image_raw", "/all/image_raw"):
        bag.image(topic, FIRST_NS, picture(0), "mono8")
    path = bag.close()
    assert open_sequence(path, "/part/image_raw").intrinsics == CAMERA
    assert (
        open_sequence(path, "/all/image_raw").intrinsics.fx == 60
    )  # the driver states a binning of whole images


def test_rectified_images_stand_for_the_raw_ones_beside_them(new_bag: NewBag, kind: str):
    bag = new_bag(kind)
    drive(bag)
    bag.image("/cam0/image_rect", FIRST_NS, picture(0), "mono8")
    (name,) = list(sequence_kinds(path := bag.close()))
    assert name == "/cam0/image_rect" and open_sequence(path).intrinsics.fx == 31


def test_a_clock_that_was_set_back_gives_way_to_the_times_of_recording(
    new_bag: NewBag, kind: str, caplog: pytest.LogCaptureFixture
):
    bag = new_bag(kind)
    bag.camera_info("/cam0/camera_info", CAMERA, "plumb_bob", (0.0,) * 5)
    for k in range(40):
        early_ns = 21 * STEP_NS if k >= 20 else 0
        bag.image(
            "/cam0/image_raw",
            FIRST_NS + k * STEP_NS - early_ns,
            picture(k),
            "mono8",
            late_ns=early_ns,
        )
    sequence = open_sequence(bag.close())
    np.testing.assert_allclose(np.diff(sequence.stamps), STEP_NS / 1e9, atol=1e-6)
    np.testing.assert_array_equal(sequence.frame(21).image[:, :, 0], picture(21))
    assert "1.00 s at message 20" in caplog.text


def test_a_camera_file_beside_a_bag_may_have_the_height_alone(new_bag: NewBag):
    bag = new_bag()
    drive(bag)
    path = bag.close()
    (path.parent / "camera.yaml").write_text("camera_height_m: 1.3\n")
    sequence = open_sequence(path)
    assert sequence.camera_height_m == 1.3 and sequence.intrinsics == CAMERA


def test_true_poses_and_scans_come_with_their_static_transforms(new_bag: NewBag, kind: str):
    """The body moves 1 m along its x a frame; the camera looks along that axis, the LiDAR is 2 m above the camera."""
    bag = new_bag(kind)
    drive(bag)
    half = 0.5
    bag.mount("body", "camera", bag.transform((0.1, 0, 0), (-half, half, -half, half)))
    bag.mount("camera", "lidar", bag.transform((0, -2, 0)))
    bag.mount("body", "broken", bag.transform((0, 0, 0), (0, 0, 0, 0)))  # it is left out
    for k in range(-1, FRAMES + 1):
        transform = bag.transform((k, 5, 0))
        bag.write(
            "/ground_truth",
            FIRST_NS + k * STEP_NS,
            bag.stamped_transform(FIRST_NS + k * STEP_NS, "w", "body", transform),
        )
    fields = [
        bag.make("sensor_msgs/msg/PointField", name=n, offset=4 * i, datatype=7, count=1)
        for i, n in enumerate("xyz")
    ]
    lost = bag.stamped_transform(FIRST_NS + 1, "w", "body", bag.transform((9, 9, 9), (0, 0, 0, 0)))
    bag.write("/ground_truth", FIRST_NS + 1, lost)
    points = np.array([[1, 2, 3, 0], [np.nan, 0, 0, 0], [4, 5, 6, 0]], np.float32)
    for late_ns, shift in ((9_000_000, 0), (24_000_000, 7)):  # the second is farther from the image
        cloud = bag.make(
            "sensor_msgs/msg/PointCloud2",
            header=bag.header(FIRST_NS + 2 * STEP_NS + late_ns, "lidar"),
            height=1,
            width=3,
            fields=fields,
            is_bigendian=False,
            point_step=16,
            row_step=48,
            data=(points + shift).view(np.uint8).ravel(),
            is_dense=False,
        )
        bag.write("/points", FIRST_NS + 3 * STEP_NS + late_ns, cloud)
    sequence = open_sequence(bag.close())
    assert sequence.reference[:, :3, 3] == pytest.approx(
        np.outer(np.arange(FRAMES), [0, 0, 1]), abs=1e-9
    )
    assert [k for k in range(FRAMES) if sequence.has_scan(k)] == [2]
    assert sequence.scan(2).tolist() == [[1, 2, 3], [4, 5, 6]]
    assert sequence.T_camera_lidar is not None and sequence.T_camera_lidar[:3, 3].tolist() == [
        0,
        -2,
        0,
    ]


def test_damaged_bags_are_named_in_one_line(new_bag: NewBag, kind: str):
    bag = new_bag(kind)
    drive(bag)
    path = bag.close()
    file = (
        path
        if path.is_file()
        else next(each for each in path.iterdir() if each.suffix in (".db3", ".mcap"))
    )
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    with pytest.raises(SequenceError, match=r"bag .*walk.* cannot be read") as caught:
        open_sequence(path)
    assert "\n" not in str(caught.value)


def test_an_mcap_of_another_program_is_named_and_converted_as_advised(
    tmp_path: Path, new_bag: NewBag
):
    header = bytes(4) + struct.pack("<I", 4) + b"test"  # no profile, and the library
    start = b"\x89MCAP0\r\n" + struct.pack("<BQ", 1, len(header)) + header
    (tmp_path / "walk.mcap").write_bytes(start + bytes(40))
    with pytest.raises(SequenceError, match=r"Profile is not ros2.*convert it to a bag of ROS 2"):
        open_sequence(tmp_path / "walk.mcap")
    converted = new_bag("mcap", "converted")
    drive(converted)
    assert len(open_sequence(converted.close())) == FRAMES


@pytest.mark.parametrize("how", ["tf", "topic", "frame", "unnamed"])
def test_true_poses_are_those_that_are_named_so(
    new_bag: NewBag, kind: str, how: str, caplog: pytest.LogCaptureFixture
):
    bag = new_bag(kind)
    drive(bag)
    bag.mount("rig", "camera", bag.transform((0, 0, 1)))
    for k in range(-1, FRAMES + 1):
        stamp, where = FIRST_NS + k * STEP_NS, bag.transform((k, 5, 0))
        each = bag.stamped_transform(
            stamp, "vicon/world", "rig" if how == "tf" else "camera", where
        )
        point = bag.make("geometry_msgs/msg/Point", x=float(k), y=5.0, z=0.0)
        pose = bag.make("geometry_msgs/msg/Pose", position=point, orientation=where.rotation)
        pose = bag.make("geometry_msgs/msg/PoseStamped", header=bag.header(stamp, "w"), pose=pose)
        topic, message = {
            "tf": ("/tf", bag.make("tf2_msgs/msg/TFMessage", transforms=[each])),
            "topic": ("/mocap/pose", pose),
            "frame": ("/pose", each),
            "unnamed": ("/pose", pose),
        }[how]
        bag.write(topic, stamp, message)
    reference = open_sequence(bag.close()).reference
    if how == "unnamed":
        assert reference is None and "/pose is not named as truth" in caplog.text
    else:
        assert reference is not None and reference[:, 0, 3] == pytest.approx(
            np.arange(FRAMES), abs=1e-6
        )


def test_a_calibration_without_a_size_is_of_the_images(new_bag: NewBag, kind: str):
    bag = new_bag(kind)
    bag.camera_info(
        "/cam0/camera_info", SimpleNamespace(**(vars(CAMERA) | {"width": 0, "height": 0})), "", ()
    )
    bag.image("/cam0/image_raw", FIRST_NS, picture(0), "mono8")
    assert open_sequence(bag.close()).intrinsics == CAMERA


def test_compressed_images_of_16_bits_share_a_stretch(new_bag: NewBag, kind: str):
    bag = new_bag(kind)
    bag.camera_info("/c/camera_info", CAMERA, "", ())
    for k in range(2):
        values = (7000 + 4 * (k + 1) * picture(0).astype(np.uint16)).astype(np.uint16)
        data, stamp = cv2.imencode(".png", values)[1].ravel(), FIRST_NS + k * STEP_NS
        fields = {"header": bag.header(stamp, "c"), "format": "mono16; png", "data": data}
        bag.write(
            "/c/image/compressed", stamp, bag.make("sensor_msgs/msg/CompressedImage", **fields)
        )
    sequence = open_sequence(bag.close())
    dark, bright = (float(sequence.frame(k).image.mean()) for k in range(2))
    assert bright == pytest.approx(2 * dark, rel=0.05)


def test_a_bag_without_images_says_what_it_holds(new_bag: NewBag, kind: str):
    bag = new_bag(kind)
    bag.camera_info("/cam0/camera_info", CAMERA, "plumb_bob", (0.0,) * 5)
    bag.image("/depth/image_raw", FIRST_NS, np.ones((24, 40), np.uint16), "16UC1")
    path = bag.close()
    with pytest.raises(
        SequenceError,
        match=r"no topic with images of a camera: it holds .*/depth/image_raw \(sensor",
    ):
        open_sequence(path)
    assert examine(path)[-1].startswith("missing")


def test_without_rosbags_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "walk.bag").write_bytes(b"")

    def absent(name: str) -> None:
        raise ImportError(f"No module named {name}")

    monkeypatch.setattr(imports.importlib, "import_module", absent)
    with pytest.raises(SlamError, match=r"bags need rosbags .*erfsfm-slam\[ros\]"):
        open_sequence(tmp_path / "walk.bag")


@pytest.fixture(params=["ros1", "mcap", pytest.param("sqlite", marks=pytest.mark.slow)])
def kind(request: pytest.FixtureRequest) -> str:
    value: str = request.param
    return value


@pytest.fixture
def new_bag(tmp_path: Path) -> Callable[..., BagWriter]:
    return lambda kind="mcap", name="walk": BagWriter(tmp_path / name, kind)
