"""Which camera file belongs to a sequence, and calibrations of other programs."""

from pathlib import Path

import numpy as np
import pytest

from erfsfm.common.errors import DataError
from slam.frames import Intrinsics
from slam.runtime.errors import SequenceError
from slam.sequences.camera_file import find_camera_file, read_explicit

IMAGES = Intrinsics(40, 24, 30, 30, 20, 12)


def written(folder: Path, text: str) -> Path:
    (folder / "camera.yaml").write_text(text)
    return folder / "camera.yaml"


def test_search_order(tmp_path: Path, camera_yaml: str) -> None:
    inner = tmp_path / "inner"
    inner.mkdir()
    with pytest.raises(SequenceError, match=r"no camera\.yaml for images: looked in .*inner and "):
        find_camera_file(None, inner, tmp_path, wanted_by="images", images=IMAGES)
    written(tmp_path, camera_yaml)
    assert find_camera_file(None, inner, tmp_path, wanted_by="images", images=IMAGES).fps == 5
    written(inner, camera_yaml.replace("fps: 5", "fps: 6"))
    assert find_camera_file(None, inner, tmp_path, wanted_by="images", images=IMAGES).fps == 6
    assert find_camera_file(tmp_path / "camera.yaml", inner, wanted_by="images", images=IMAGES).fps == 5
    with pytest.raises(SequenceError, match=r"no camera file .*nowhere\.yaml"):
        find_camera_file(tmp_path / "nowhere.yaml", inner, wanted_by="images", images=IMAGES)


def test_a_horizontal_field_of_view_is_a_camera(tmp_path: Path) -> None:
    camera = find_camera_file(Path("fov=90"), tmp_path, wanted_by="images", images=IMAGES)
    assert (camera.width, camera.height, camera.fps) == (40, 24, 10)
    assert camera.fx == camera.fy == pytest.approx(20)  # half the width of 40 pixels at 45 degrees
    assert (camera.cx, camera.cy) == (19.5, 11.5)
    assert find_camera_file(Path("fov=90,fps=25"), tmp_path, wanted_by="images", images=IMAGES, fps=30).fps == 25
    assert find_camera_file(Path("fov=90"), tmp_path, wanted_by="images", images=IMAGES, fps=30).fps == 30


KALIBR = """cam0:
  camera_model: pinhole
  distortion_coeffs: [-0.1, 0.02, 0.001, -0.002]
  distortion_model: radtan
  intrinsics: [30.0, 31.0, 20.0, 12.0]
  resolution: [40, 24]
  rostopic: /cam0/image_raw
"""
ROS = """image_width: 40
image_height: 24
camera_name: front
camera_matrix: {rows: 3, cols: 3, data: [30.0, 0.0, 20.0, 0.0, 31.0, 12.0, 0.0, 0.0, 1.0]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [-0.1, 0.02, 0.001, -0.002, 0.0]}
"""
ORB = """%YAML:1.0
---
Camera.type: "PinHole"
Camera.fx: 30.0
Camera.fy: 31.0
Camera.cx: 20.0
Camera.cy: 12.0
Camera.k1: -0.1
Camera.k2: 0.02
Camera.p1: 0.001
Camera.p2: -0.002
Camera.width: 40
Camera.height: 24
Camera.fps: 20.0
IMU.T_b_c1: !!opencv-matrix
   rows: 1
   cols: 1
   dt: f
   data: [1.0]
"""
COLMAP = "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n1 OPENCV 40 24 30 31 20.5 12.5 -0.1 0.02 0.001 -0.002\n"


@pytest.mark.parametrize(
    ("name", "text", "fps"),
    [("camchain.yaml", KALIBR, 10), ("front.yaml", ROS, 10), ("TUM1.yaml", ORB, 20), ("cameras.txt", COLMAP, 10)],
)
def test_the_same_camera_by_every_program(tmp_path: Path, name: str, text: str, fps: float) -> None:
    (tmp_path / name).write_text(text)
    camera = read_explicit(tmp_path / name)
    assert (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy) == (40, 24, 30, 31, 20, 12)
    assert camera.model == "opencv" and camera.fps == fps
    np.testing.assert_array_equal(camera.distortion[:4], [-0.1, 0.02, 0.001, -0.002])


def test_lenses(tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(KALIBR.replace("radtan", "equidistant"))
    assert read_explicit(path).model == "fisheye"
    path.write_text(ROS.replace("[-0.1, 0.02, 0.001, -0.002, 0.0]", "[0.0, 0.0, 0.0, 0.0, 0.0]"))
    assert read_explicit(path).model == "pinhole"
    path = tmp_path / "cameras.txt"
    path.write_text("1 SIMPLE_RADIAL 40 24 30 20.5 12.5 -0.1\n")
    camera = read_explicit(path)
    assert (camera.fx, camera.fy, camera.cx, camera.distortion) == (30, 30, 20, (-0.1, 0, 0, 0))


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("camchain.yaml", KALIBR.replace("radtan", "spiral"), "spiral"),
        ("camchain.yaml", KALIBR.replace("  resolution: [40, 24]\n", ""), "Kalibr.* lacks 'resolution'"),
        ("cameras.txt", "1 THIN_PRISM 40 24 1 2 3\n", "THIN_PRISM"),
        ("cameras.txt", "nothing\n", "CAMERA_ID"),
    ],
)
def test_what_is_wrong_is_one_line(tmp_path: Path, name: str, text: str, words: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises((SequenceError, DataError), match=words) as caught:
        read_explicit(tmp_path / name)
    assert "\n" not in str(caught.value)
