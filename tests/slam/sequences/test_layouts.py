"""The layouts of public data sets: images, stamps, cameras, true poses, depth and scans; what is missing or damaged."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from erfsfm.common.readers.camera_file import camera_of
from slam.runtime.errors import MissingFrameError, SequenceError
from slam.sequences.camera_file import Undistortion
from slam.sequences.catalogue import open_sequence, sequence_kinds

# EuRoC: distorted images, stamps in nanoseconds, true poses of the body, rows without an image

FIRST_NS, STEP_NS, FRAMES = 1403715273262142976, 50_000_000, 6
SENSOR = """%YAML:1.0
sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: [0.0, -1.0, 0.0, 0.5,
         1.0, 0.0, 0.0, 0.0,
         0.0, 0.0, 1.0, 0.0,
         0.0, 0.0, 0.0, 1.0]
rate_hz: 20
resolution: [40, 24]
camera_model: pinhole
intrinsics: [30, 30, 20, 12] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.2, 0.05, 0.0, 0.0]
"""


@pytest.fixture
def flight(tmp_path: Path, images) -> Path:
    """Six frames; the body goes 1 m along its y axis a frame, without turning."""
    body = tmp_path / "MH_07/mav0"
    stamps = [FIRST_NS + k * STEP_NS for k in range(FRAMES)]
    images(body / "cam0/data", [f"{stamp}.png" for stamp in stamps])
    rows = "".join(f"{stamp},{stamp}.png\r\n" for stamp in stamps)
    (body / "cam0/data.csv").write_text("#timestamp [ns],filename\r\n" + rows, newline="")
    (body / "cam0/sensor.yaml").write_text(SENSOR)
    return body


def write_truth(body: Path, first: int, stop: int) -> None:
    folder = body / "state_groundtruth_estimate0"
    folder.mkdir()
    rows = [f"{FIRST_NS + k * STEP_NS},7,{k},3,1,0,0,0,0.1,0.1,0.1\n" for k in range(first, stop)]
    (folder / "data.csv").write_text("#timestamp, p_RS_R_x [m], ...\n" + "".join(rows))


@pytest.mark.parametrize("given", [".", "..", "../.."])
def test_euroc_opens(flight: Path, given: str):
    write_truth(flight, 0, FRAMES)
    sequence = open_sequence((flight / given).resolve())
    assert (sequence.name, len(sequence), sequence.camera_height_m) == ("MH_07", FRAMES, None)
    assert sequence.stamps[1] == (FIRST_NS + STEP_NS) / 10**9
    assert sequence.provenance() == ("euroc/MH_07[0:6]",)
    assert sequence.intrinsics.fx != 30 and sequence.frame(3).image.shape == (24, 40, 3)
    # the camera is turned by 90 degrees about the body's z: its x axis is the body's y
    assert sequence.reference[:, :3, 3] == pytest.approx(
        np.outer(np.arange(FRAMES), [1, 0, 0]), abs=1e-6
    )


def test_true_poses_of_some_frames_are_those_of_an_excerpt(
    flight: Path, caplog: pytest.LogCaptureFixture
):
    write_truth(flight, 3, FRAMES)
    with caplog.at_level(logging.WARNING):
        assert open_sequence(flight).reference is None
    assert "no pose of image 0" in caplog.text and "frames 1:6 have one each" in caplog.text
    excerpt = open_sequence(flight, frames="3:6").reference
    assert excerpt is not None and excerpt[:, 0, 3] == pytest.approx([0, 1, 2])


def test_rows_without_an_image_are_gaps(flight: Path):
    for k in (0, 3):
        (flight / f"cam0/data/{FIRST_NS + k * STEP_NS}.png").unlink()
    sequence = open_sequence(flight)
    assert len(sequence) == 5 and sequence.stamps[0] == (FIRST_NS + STEP_NS) / 10**9
    assert sequence.frame(1).image[0, 0, 0] == 20
    with pytest.raises(MissingFrameError, match=rf"no image {FIRST_NS + 3 * STEP_NS}\.png"):
        sequence.frame(2)


def test_a_camera_file_replaces_the_calibration_and_one_beside_gives_the_height(
    flight: Path, tmp_path: Path, camera_yaml: str, caplog: pytest.LogCaptureFixture
):
    given = tmp_path / "mine.yaml"
    given.write_text(camera_yaml)
    sensor = flight / "cam0/sensor.yaml"
    sensor.write_text(SENSOR.replace("radial-tangential", "omni"))  # a lens that is not known
    assert open_sequence(flight, camera=given).intrinsics.fx == 30
    sensor.unlink()
    write_truth(flight, 0, FRAMES)
    sequence = open_sequence(flight, camera=given)
    assert sequence.intrinsics.fx == 30 and sequence.reference is None
    assert "sensor.yaml, which says where" in caplog.text
    sensor.write_text(SENSOR)
    (flight.parent / "camera.yaml").write_text(camera_yaml + "camera_height_m: 1.2\n")
    sequence = open_sequence(flight)
    assert sequence.camera_height_m == 1.2 and sequence.intrinsics.fx != 30


@pytest.mark.data
def test_the_real_sample(data_root: Path):
    sequence = open_sequence(data_root / "euroc_micro")
    assert (sequence.name, len(sequence)) == ("euroc_micro", 95)
    assert np.diff(sequence.stamps) == pytest.approx(0.05, abs=1e-4)
    K = sequence.intrinsics
    assert (K.width, K.height, K.cx, K.cy) == (752, 480, 367.215, 248.375)
    assert sequence.frame(94).image.std() > 20


# TUM RGB-D: a table of images, true poses and registered depth maps

STAMPS = [100.02, 100.05, 100.09]


@pytest.fixture
def freiburg(tmp_path: Path, images, camera_yaml: str) -> Path:
    root = tmp_path / "freiburg"
    images(root / "rgb", [f"{stamp}.png" for stamp in STAMPS])
    rows = "".join(f"{stamp} rgb/{stamp}.png\n" for stamp in STAMPS)
    (root / "rgb.txt").write_text("# colour images\n# timestamp filename\n" + rows)
    (root / "camera.yaml").write_text(camera_yaml)
    return root


def write_tum_truth(freiburg: Path, stamps: np.ndarray) -> None:
    """Straight ahead at 1 m/s, turning about y by 0.5 rad/s."""
    half = 0.25 * (stamps - 100)
    rows = [
        f"{s:.4f} 0 0 {s - 100:.6f} 0 {np.sin(h):.9f} 0 {np.cos(h):.9f}\n"
        for s, h in zip(stamps, half)
    ]
    (freiburg / "groundtruth.txt").write_text("# timestamp tx ty tz qx qy qz qw\n" + "".join(rows))


def test_tum_opens(freiburg: Path):
    sequence = open_sequence(freiburg)
    assert (sequence.name, len(sequence), sequence.reference) == ("freiburg", 3, None)
    assert sequence.stamps.tolist() == STAMPS
    assert sequence.frame(2).image[0, 0, 0] == 20
    assert sequence.provenance() == ("tum/freiburg[0:3]",)
    assert sequence.camera_height_m is None and not sequence.has_scan(0)


def test_tum_truth_is_interpolated(freiburg: Path):
    write_tum_truth(freiburg, np.arange(100.0, 100.2, 0.02))
    reference = open_sequence(freiburg).reference
    assert np.array_equal(reference[0], np.eye(4))
    # 0.03 s after the first image, seen from a camera turned by 0.01 rad
    assert reference[1, :3, 3] == pytest.approx(
        [-0.03 * np.sin(0.01), 0, 0.03 * np.cos(0.01)], abs=1e-6
    )
    assert reference[1, 0, 2] == pytest.approx(np.sin(0.015), abs=1e-6)


def test_tum_bad_rows_are_left_out(freiburg: Path, caplog: pytest.LogCaptureFixture):
    known = open_sequence(freiburg)
    index = freiburg / "rgb.txt"
    rows = index.read_text().splitlines()
    index.write_text("\n".join([*rows, rows[-1], "soon rgb/100.02.png"]))
    again = open_sequence(freiburg)
    np.testing.assert_array_equal(again.stamps, known.stamps)
    assert len(again) == len(known) and "2 of " in caplog.text


@pytest.mark.parametrize(
    "rows", [("100.04 near.png", "100.30 far.png"), ("100.30 far.png", "100.04 near.png")]
)
def test_registered_depth_maps_belong_to_the_images_of_their_stamps(
    freiburg: Path, rows: tuple[str, str]
):
    sequence = open_sequence(freiburg)
    assert sequence.true_depth_frames() == []
    cv2.imwrite(str(freiburg / "near.png"), np.full((4, 6), 10_000, dtype=np.uint16))
    cv2.imwrite(str(freiburg / "far.png"), np.full((4, 6), 20_000, dtype=np.uint16))
    (freiburg / "depth.txt").write_text("\n".join(["# timestamp filename", *rows]))
    sequence = open_sequence(freiburg)
    assert sequence.true_depth_frames() == [1]
    np.testing.assert_array_equal(sequence.true_depth(1), np.full((4, 6), 2.0))


# TUM's monocular benchmark: the FOV lens, stamps, true poses of start and end

LENS = "0.5 0.8 0.5 0.5 0.9"


@pytest.fixture
def walk(tmp_path: Path, images) -> Path:
    folder = tmp_path / "sequence_01"
    images(folder / "images", [f"{k:05d}.jpg" for k in range(6)])
    (folder / "times.txt").write_text(
        "".join(f"{k:05d} {100 + 0.05 * k:.6f} 3.5\n" for k in range(6))
    )
    (folder / "camera.txt").write_text(f"{LENS}\n40 24\ncrop\n40 24\n")
    rows = [f"{100 + 0.05 * k:.6f} 0 0 {k} 0 0 0 1\n" for k in range(3)]
    (folder / "groundtruthSync.txt").write_text(
        "".join(rows) + "100.25 NaN NaN NaN NaN NaN NaN NaN\n"
    )
    return folder


@pytest.mark.parametrize("lens", [LENS, f"FOV {LENS}"])
def test_tum_mono_opens(walk: Path, lens: str):
    (walk / "camera.txt").write_text(f"{lens}\n40 24\ncrop\n40 24\n")
    assert sequence_kinds(walk) == {"sequence_01": "TUM mono"}
    sequence = open_sequence(walk)
    assert sequence.stamps == pytest.approx(100 + 0.05 * np.arange(6))
    assert (sequence.intrinsics.cx, sequence.intrinsics.cy) == (19.5, 11.5)
    assert sequence.intrinsics.fx / sequence.intrinsics.fy == pytest.approx(20 / 19.2)
    assert sequence.reference is None
    start = open_sequence(walk, frames="0:3").reference
    assert start is not None and start[:, 2, 3] == pytest.approx([0, 1, 2])


def test_the_fov_lens_bends_radii_to_angles():
    """A ray at 45 degrees, its tangent 1, by the formula of the model; the centre stays."""
    keys = {"width": 200, "height": 100, "fx": 90, "fy": 90, "cx": 99.5, "cy": 49.5, "fps": 10}
    lens = Undistortion(camera_of({**keys, "model": "fov", "distortion": [0.9]}, "here"))
    K = np.array([[50, 0, 99.5], [0, 50, 49.5], [0, 0, 1.0]])
    seen = lens.distort(np.array([[149.5, 49.5], [99.5, 49.5]]), K)
    assert seen[0] == pytest.approx([99.5 + 90 * np.arctan(2 * np.tan(0.45)) / 0.9, 49.5])
    assert seen[1] == pytest.approx([99.5, 49.5])
    stripes = np.zeros((100, 200, 3), np.uint8)
    stripes[:, 100:] = 255
    flat = lens.apply(stripes)
    assert flat[:, :99].max() == 0 and flat[:, 101:].min() == 255


def test_tum_mono_damage(walk: Path):
    (walk / "camera.txt").write_text("0.5 0.8\n40 24\n")
    with pytest.raises(SequenceError, match=r"camera\.txt needs a row of fx fy cx cy"):
        open_sequence(walk)
    (walk / "camera.txt").write_text(f"{LENS}\n40 24\n")
    (walk / "times.txt").write_text("00000 soon\n" * 6)
    with pytest.raises(SequenceError, match=r"times\.txt, line"):
        open_sequence(walk)
    for path in (walk / "images").iterdir():
        path.unlink()
    with pytest.raises(SequenceError, match=r"unpack images\.zip there"):
        open_sequence(walk)


# 7-Scenes and ScanNet: images, registered depth and one file of a true pose a frame

POSE = "0 0 1 {z}\n0 1 0 2\n-1 0 0 {k}\n0 0 0 1\n"  # turned about y: the camera looks along the world's x
LOST = "-inf -inf -inf -inf\n" * 4


@pytest.fixture
def chess(tmp_path: Path, images) -> Path:
    """Two sequences; of the first frame 2 is missing, and the depth of frame 1 has an unknown pixel."""
    for name in ("seq-01", "seq-02"):
        folder = tmp_path / "chess" / name
        images(folder, [f"frame-{k:06d}.color.png" for k in range(5)], 640, 480)
        for k in range(5):
            (folder / f"frame-{k:06d}.pose.txt").write_text(POSE.format(k=k, z=0))
    depth = np.full((480, 640), 1500, np.uint16)
    depth[0, 0] = 65535
    cv2.imwrite(str(tmp_path / "chess/seq-01/frame-000001.depth.png"), depth)
    (tmp_path / "chess/seq-01/frame-000002.color.png").unlink()
    return tmp_path / "chess"


@pytest.fixture
def scene(tmp_path: Path, images) -> Path:
    """Every tenth frame from 20 on; tracking was lost at the second."""
    folder = tmp_path / "scene0000_00"
    images(folder / "color", [f"{k}.jpg" for k in (20, 30, 40, 50)])
    for name, text in (("pose", POSE), ("intrinsic", "")):
        (folder / name).mkdir()
        for k in (20, 30, 40, 50) if text else ():
            (folder / name / f"{k}.txt").write_text(LOST if k == 30 else text.format(k=k, z=1))
    (folder / "intrinsic/intrinsic_color.txt").write_text(
        "30 0 20 0\n0 31 12 0\n0 0 1 0\n0 0 0 1\n"
    )
    (folder / "depth").mkdir()
    cv2.imwrite(str(folder / "depth/40.png"), np.full((12, 20), 2500, np.uint16))
    return folder


def test_seven_scenes(chess: Path):
    assert sequence_kinds(chess) == {"seq-01": "7-Scenes", "seq-02": "7-Scenes"}
    sequence = open_sequence(chess, "seq-01")
    assert (sequence.name, len(sequence), sequence.intrinsics.fx) == ("chess_seq-01", 5, 585)
    assert np.diff(sequence.stamps) == pytest.approx(1 / 30)
    assert sequence.reference[:, :3, 3] == pytest.approx(np.outer(np.arange(5), [-1, 0, 0]))
    assert sequence.true_depth_frames() == [1]
    assert (sequence.true_depth(1)[0, 0], sequence.true_depth(1)[1, 1]) == (0, 1.5)
    with pytest.raises(MissingFrameError, match=r"no image frame-000002\.color\.png"):
        sequence.frame(2)
    assert sequence.provenance() == ("7scenes/chess_seq-01[0:5]",)
    assert open_sequence(chess / "seq-02").name == "chess_seq-02"


def test_scannet(scene: Path, caplog: pytest.LogCaptureFixture):
    with caplog.at_level(logging.WARNING):
        sequence = open_sequence(scene)
    assert sequence_kinds(scene) == {"scene0000_00": "ScanNet"}
    assert (len(sequence), sequence.intrinsics.fy, sequence.intrinsics.width) == (4, 31, 40)
    assert sequence.stamps == pytest.approx(np.array([20, 30, 40, 50]) / 30)
    assert sequence.reference is None and "frames 2:4 have one each" in caplog.text
    assert sequence.true_depth_frames() == [2] and sequence.true_depth(2)[0, 0] == 2.5
    (scene / "intrinsic/intrinsic_color.txt").write_text("unknown")
    assert open_sequence(scene, camera=Path("fov=90")).intrinsics.fx == pytest.approx(20)
    part = open_sequence(scene, camera=Path("fov=90"), frames="2:4").reference
    assert part is not None and part[1, :3, 3] == pytest.approx([-10, 0, 0])


# nuScenes: the front camera by the data set's own tables, with true poses and LiDAR

HALF = 0.5  # the quaternion wxyz (0.5, -0.5, 0.5, -0.5) turns a car's axes to a camera's that looks ahead
AHEAD = [HALF, -HALF, HALF, -HALF]
KEY_FRAMES = 5


@pytest.fixture
def nuscenes(tmp_path: Path, images) -> Path:
    """Two scenes; the car goes 1 m along x each 80 ms. The rows are not in the order of time."""
    root = tmp_path / "nuscenes"
    images(root / "samples/CAM_FRONT", [f"{k}.jpg" for k in range(KEY_FRAMES)])
    (root / "samples/LIDAR_TOP").mkdir(parents=True)
    np.array([[1, 2, 3, 4, 5], [6, 7, 8, 9, 0]], np.float32).tofile(
        root / "samples/LIDAR_TOP/2.pcd.bin"
    )
    mounts = {"cam": ([1.7, 0, 1.5], AHEAD), "lidar": ([0.9, 0, 1.8], [1, 0, 0, 0])}
    data: list[dict[str, Any]] = []
    for k in (3, 0, 1, 4, 2):
        row = {
            "sample_token": "s0",
            "ego_pose_token": f"e{k}",
            "calibrated_sensor_token": "cam",
            "width": 40,
            "height": 24,
        }
        data.append(
            {**row, "timestamp": 10**15 + 80_000 * k, "filename": f"samples/CAM_FRONT/{k}.jpg"}
        )
    row = {
        "sample_token": "s0",
        "ego_pose_token": "e2",
        "calibrated_sensor_token": "lidar",
        "width": 0,
        "height": 0,
    }
    data.append({**row, "timestamp": 10**15 + 170_000, "filename": "samples/LIDAR_TOP/2.pcd.bin"})
    tables = {
        "scene": [{"token": "a", "name": "scene-0061"}, {"token": "b", "name": "scene-0103"}],
        "sample": [{"token": "s0", "scene_token": "a"}, {"token": "s1", "scene_token": "b"}],
        "sensor": [{"token": "c", "channel": "CAM_FRONT"}, {"token": "l", "channel": "LIDAR_TOP"}],
        "calibrated_sensor": [
            {
                "token": name,
                "sensor_token": name[0],
                "translation": t,
                "rotation": q,
                "camera_intrinsic": K,
            }
            for (name, (t, q)), K in zip(
                mounts.items(), ([[30, 0, 20], [0, 30, 12], [0, 0, 1]], []), strict=True
            )
        ],
        "ego_pose": [
            {"token": f"e{k}", "translation": [k, 5, 0], "rotation": [1, 0, 0, 0]}
            for k in range(KEY_FRAMES)
        ],
        "sample_data": data,
    }
    (root / "v1.0-mini").mkdir()
    for name, rows in tables.items():
        (root / "v1.0-mini" / f"{name}.json").write_text(json.dumps(rows))
    return root


def test_nuscenes(nuscenes: Path):
    assert sequence_kinds(nuscenes) == {"scene-0061": "nuScenes", "scene-0103": "nuScenes"}
    sequence = open_sequence(nuscenes, "scene-0061")
    assert (len(sequence), sequence.intrinsics.fx, sequence.camera_height_m) == (
        KEY_FRAMES,
        30,
        1.5,
    )
    assert sequence.stamps == pytest.approx(1e9 + 0.08 * np.arange(KEY_FRAMES))
    assert sequence.frame(3).image[0, 0, 0] == pytest.approx(30, abs=2)
    assert sequence.reference[:, :3, 3] == pytest.approx(
        np.outer(np.arange(KEY_FRAMES), [0, 0, 1]), abs=1e-12
    )
    assert [k for k in range(KEY_FRAMES) if sequence.has_scan(k)] == [2]
    assert sequence.scan(2).tolist() == [[1, 2, 3], [6, 7, 8]]
    # the LiDAR is 0.8 m behind the camera and 0.3 m above it
    assert sequence.T_camera_lidar[:3, 3] == pytest.approx([0, -0.3, -0.8])
    (nuscenes / "samples/CAM_FRONT/3.jpg").unlink()
    with pytest.raises(MissingFrameError, match=r"no image 3\.jpg"):
        open_sequence(nuscenes, "scene-0061").frame(3)


@pytest.mark.parametrize(
    "name, text, message",
    [
        ("scene", "{", "cannot read table .*scene.json"),
        ("scene", "{}", r"scene\.json is no table of nuScenes"),
        ("ego_pose", "[]", "are not those of nuScenes: KeyError"),
        ("sample_data", "[]", "CAM_FRONT"),
    ],
)
def test_nuscenes_damaged_tables(nuscenes: Path, name: str, text: str, message: str):
    (nuscenes / "v1.0-mini" / f"{name}.json").write_text(text)
    with pytest.raises(SequenceError, match=message):
        open_sequence(nuscenes, "scene-0061")
