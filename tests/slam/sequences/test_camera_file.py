"""Which camera file belongs to a sequence, and calibrations of other programs."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from erfsfm.common.errors import DataError
from erfsfm.common.readers.camera_file import UNKNOWN_FX_SIGMA, CameraFile
from slam.frames import Intrinsics
from slam.runtime.errors import SequenceError
from slam.sequences.camera_file import (
    Undistortion,
    find_camera_file,
    fixed_to,
    read_explicit,
    require_stated,
)

IMAGES = Intrinsics(40, 24, 30, 30, 20, 12)
WIDTH, HEIGHT = 320, 240
LENSES = {
    "barrel": ("opencv", (-0.30, 0.10, 0.001, -0.0005, 0.0)),
    "pincushion": ("opencv", (0.12, 0.02, 0.0, 0.0)),
    "rational": ("opencv", (0.1, -0.05, 0.0, 0.0, 0.01, 0.35, 0.02, 0.0)),
    "fisheye": ("fisheye", (-0.02, 0.01, -0.004, 0.001)),
    "none": ("opencv", (0.0, 0.0, 0.0, 0.0)),
}


def written(folder: Path, text: str) -> Path:
    (folder / "camera.yaml").write_text(text)
    return folder / "camera.yaml"


NAMELESS = """image_width: 40
image_height: 24
distortion_model: '{}'
camera_matrix: {{data: [30, 0, 20, 0, 30, 12, 0, 0, 1]}}
distortion_coefficients: {{data: {}}}
"""


def test_search_order(tmp_path: Path, camera_yaml: str):
    inner = tmp_path / "inner"
    inner.mkdir()
    with pytest.raises(SequenceError, match=r"no camera\.yaml for images: looked in .*inner and "):
        find_camera_file(None, inner, tmp_path, wanted_by="images", images=IMAGES)
    written(tmp_path, camera_yaml)
    assert find_camera_file(None, inner, tmp_path, wanted_by="images", images=IMAGES).fps == 5
    written(inner, camera_yaml.replace("fps: 5", "fps: 6"))
    assert find_camera_file(None, inner, tmp_path, wanted_by="images", images=IMAGES).fps == 6
    assert (
        find_camera_file(tmp_path / "camera.yaml", inner, wanted_by="images", images=IMAGES).fps
        == 5
    )
    with pytest.raises(SequenceError, match=r"no camera file .*nowhere\.yaml"):
        find_camera_file(tmp_path / "nowhere.yaml", inner, wanted_by="images", images=IMAGES)


def test_a_horizontal_field_of_view_is_a_camera(tmp_path: Path):
    camera = find_camera_file(Path("fov=90"), tmp_path, wanted_by="images", images=IMAGES)
    assert (camera.width, camera.height, camera.fps) == (40, 24, 10)
    assert camera.fx == camera.fy == pytest.approx(20)  # half the width of 40 pixels at 45 degrees
    assert (camera.cx, camera.cy) == (19.5, 11.5)
    assert (
        find_camera_file(
            Path("fov=90,fps=25"), tmp_path, wanted_by="images", images=IMAGES, fps=30
        ).fps
        == 25
    )
    assert (
        find_camera_file(Path("fov=90"), tmp_path, wanted_by="images", images=IMAGES, fps=30).fps
        == 30
    )


def test_a_whole_camera_on_one_line(tmp_path: Path):
    camera = find_camera_file(
        Path("fov=90,height=1.4,fps=15"), tmp_path, wanted_by="images", images=IMAGES
    )
    assert (camera.camera_height_m, camera.fps) == (1.4, 15)
    assert camera.fx == pytest.approx(20) and camera.fx_sigma == 0.1
    for words in ("auto", "auto,height=1.4", "height=1.4"):
        unknown = find_camera_file(Path(words), wanted_by="images", images=IMAGES)
        assert unknown.fx_sigma == UNKNOWN_FX_SIGMA
        with pytest.raises(SequenceError, match=r"give fov=70 here, or the camera\.yaml of a run"):
            require_stated(Path(words))
    require_stated(Path("fov=90,height=1.4"))
    for wrong in ("fov=90,width=3", "fov=900", "fov=90,fps=0", "auto,height"):
        with pytest.raises(SequenceError, match="is no field of view: write fov=70"):
            find_camera_file(Path(wrong), wanted_by="images", images=IMAGES)


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
    [
        ("camchain.yaml", KALIBR, 10),
        ("front.yaml", ROS, 10),
        ("TUM1.yaml", ORB, 20),
        ("cameras.txt", COLMAP, 10),
    ],
)
def test_the_same_camera_by_every_program(tmp_path: Path, name: str, text: str, fps: float):
    (tmp_path / name).write_text(text)
    camera = read_explicit(tmp_path / name)
    assert (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy) == (
        40,
        24,
        30,
        31,
        20,
        12,
    )
    assert camera.model == "opencv" and camera.fps == fps
    np.testing.assert_array_equal(camera.distortion[:4], [-0.1, 0.02, 0.001, -0.002])


def test_lenses(tmp_path: Path):
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
        (
            "camchain.yaml",
            KALIBR.replace("  resolution: [40, 24]\n", ""),
            "Kalibr.* lacks 'resolution'",
        ),
        ("cameras.txt", "1 THIN_PRISM 40 24 1 2 3\n", "THIN_PRISM"),
        ("cameras.txt", "nothing\n", "CAMERA_ID"),
        ("cameras.txt", "1 PINHOLE 40 24 30 30 20 12 -0.1 0.02\n", "COLMAP"),
        ("ros.yaml", NAMELESS.format("none", [-0.1, 0, 0, 0]), "coefficients are there"),
        ("ros.yaml", NAMELESS.format("", [-0.1, 0, 0]), "coefficients are there"),
        (
            "orb.yaml",
            "Camera.fx: 30\nCamera.fy: 30\nCamera.cx: 20\nCamera.cy: 12\nCamera.width: 40\n"
            "Camera.height: 24\nCamera.k4: 0.1\n",
            "Camera.k4",
        ),
    ],
)
def test_what_is_wrong_is_one_line(tmp_path: Path, name: str, text: str, words: str):
    (tmp_path / name).write_text(text)
    with pytest.raises((SequenceError, DataError), match=words) as caught:
        read_explicit(tmp_path / name)
    assert "\n" not in str(caught.value)


def lens(name: str) -> CameraFile:
    model, distortion = LENSES[name]
    calibration = {
        "width": WIDTH,
        "height": HEIGHT,
        "fx": 180,
        "fy": 175,
        "cx": 163,
        "cy": 117,
        "fps": 10,
    }
    return CameraFile.model_validate(calibration | {"model": model, "distortion": distortion})


def seen_by_lens(points_camera: np.ndarray, camera: CameraFile) -> np.ndarray:
    """Project with OpenCV's own lens model, independently of the code under test."""
    project = cv2.fisheye.projectPoints if camera.model == "fisheye" else cv2.projectPoints
    K, D, zero = Intrinsics.of(camera.pinhole).K, np.array(camera.distortion), np.zeros(3)
    points = points_camera[:, None] if camera.model == "fisheye" else points_camera
    pixels, _ = project(points, zero, zero, K, D)
    return pixels.reshape(-1, 2)


@pytest.mark.parametrize("count", [4, 5, 8])
def test_coefficients_without_a_name_are_those_of_opencv(tmp_path: Path, count: int):
    distortion = [-0.1, 0.02, *[0.0] * (count - 2)]
    (tmp_path / "ros.yaml").write_text(NAMELESS.format("", distortion))
    camera = read_explicit(tmp_path / "ros.yaml")
    assert (camera.model, list(camera.distortion)) == ("opencv", distortion)


VINS = """%YAML:1.0
model_type: PINHOLE
image_width: 40
image_height: 24
distortion_parameters: {k1: -0.1, k2: 0.02, p1: 0.0, p2: 0.0}
projection_parameters: {fx: 30, fy: 31, cx: 20, cy: 12}
"""


def test_settings_of_vins(tmp_path: Path):
    (tmp_path / "vins.yaml").write_text(VINS)
    camera = read_explicit(tmp_path / "vins.yaml")
    assert (camera.model, camera.fy, camera.distortion) == ("opencv", 31, (-0.1, 0.02, 0.0, 0.0))
    (tmp_path / "vins.yaml").write_text(VINS.replace("p2: 0.0", "p2: 0.0, k3: 0.1"))
    with pytest.raises(DataError, match="k3 of VINS cannot be used"):
        read_explicit(tmp_path / "vins.yaml")
    (tmp_path / "droid.txt").write_text("30 31 20 12\n")
    with pytest.raises(DataError, match="DROID-SLAM, lack the size"):
        read_explicit(tmp_path / "droid.txt")


@pytest.mark.parametrize("name", LENSES)
def test_points_land_on_the_pinhole_projection(name: str):
    camera = lens(name)
    undistortion = Undistortion(camera)
    pixels = undistortion.intrinsics.pixel_grid()[10::20, 10::20].reshape(-1, 2)
    u, v = pixels.astype(int).T
    taken_from = np.column_stack([table[v, u] for table in undistortion._maps])
    seen = seen_by_lens(7.0 * undistortion.intrinsics.rays(pixels), camera)
    np.testing.assert_allclose(taken_from, seen, atol=1e-3)


@pytest.mark.parametrize("name", LENSES)
def test_no_black_border_and_none_to_spare(name: str):
    undistortion = Undistortion(lens(name))
    white = undistortion.apply(np.full((HEIGHT, WIDTH, 3), 255, np.uint8))
    assert (white == 255).all()
    map_u, map_v = undistortion._maps
    assert map_u.min() >= -1e-3 and map_u.max() <= WIDTH - 1 + 1e-3
    assert map_v.min() >= -1e-3 and map_v.max() <= HEIGHT - 1 + 1e-3
    slack = min(map_u.min(), map_v.min(), WIDTH - 1 - map_u.max(), HEIGHT - 1 - map_v.max())
    assert slack < 0.02 * WIDTH


def test_folding_lens_is_refused_or_cropped():
    """A radius that runs backwards must not come into the image."""
    camera = lens("barrel").model_copy(update={"distortion": (-0.9, 0.0, 0.0, 0.0)})
    undistortion = Undistortion(camera)
    corner = (
        np.array([[0.0, 0.0]]) - undistortion.intrinsics.K[:2, 2]
    ) / undistortion.intrinsics.fx
    assert (
        np.linalg.norm(corner) < (1 / (3 * 0.9)) ** 0.5 * 1.03
    )  # where r (1 - 0.9 r^2) is largest
    hopeless = lens("barrel").model_copy(update={"distortion": (400.0, 0.0, 0.0, 0.0)})
    with pytest.raises(SequenceError, match="leaves no image free of black borders"):
        Undistortion(hopeless)
    folded = lens("barrel").model_copy(update={"distortion": (-9.0, 3.0, 0.0, 0.0)})
    with pytest.raises(SequenceError, match=r"distortion \[-9.* folds the image"):
        Undistortion(folded)


def test_black_of_a_mask_is_fixed_to_the_camera(tmp_path: Path):
    """Found beside the file, bent with the images; another size or no file is one line."""
    keys = {"width": 320, "height": 240, "fx": 200.0, "fy": 200.0, "cx": 160.0, "cy": 120.0}
    text = "".join(f"{name}: {value}\n" for name, value in {**keys, "fps": 10}.items())
    mask = np.full((240, 320), 255, np.uint8)
    mask[180:] = 0
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    plain = read_explicit(written(tmp_path, f"{text}mask: mask.png\n"))
    np.testing.assert_array_equal(fixed_to(plain, None), mask == 0)
    bent = "mask: mask.png\nmodel: opencv\ndistortion: [-0.2, 0, 0, 0]\n"
    barrel = read_explicit(written(tmp_path, text + bent))
    undistortion = Undistortion(barrel)
    fixed = fixed_to(barrel, undistortion)
    image = undistortion.apply(np.repeat(mask[..., None], 3, axis=2))
    assert fixed is not None and fixed.any() and not fixed[:170].any()
    np.testing.assert_array_equal(fixed, image[..., 0] < 128)
    assert fixed_to(read_explicit(written(tmp_path, text)), None) is None
    cv2.imwrite(str(tmp_path / "mask.png"), mask[::2])
    with pytest.raises(DataError, match="320x120, its camera 320x240"):
        fixed_to(plain, None)
    (tmp_path / "mask.png").unlink()
    with pytest.raises(DataError, match=r"mask\.png"):
        fixed_to(plain, None)
