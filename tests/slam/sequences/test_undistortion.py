import cv2
import numpy as np
import pytest

from erfsfm.common.readers.camera_file import CameraFile
from slam.frames import Intrinsics
from slam.runtime.errors import SequenceError
from slam.sequences.camera_file import Undistortion

WIDTH, HEIGHT = 320, 240
LENSES = {
    "barrel": ("opencv", (-0.30, 0.10, 0.001, -0.0005, 0.0)),
    "pincushion": ("opencv", (0.12, 0.02, 0.0, 0.0)),
    "rational": ("opencv", (0.1, -0.05, 0.0, 0.0, 0.01, 0.35, 0.02, 0.0)),
    "fisheye": ("fisheye", (-0.02, 0.01, -0.004, 0.001)),
    "none": ("opencv", (0.0, 0.0, 0.0, 0.0)),
}


def lens(name: str) -> CameraFile:
    model, distortion = LENSES[name]
    calibration = {"width": WIDTH, "height": HEIGHT, "fx": 180, "fy": 175, "cx": 163, "cy": 117, "fps": 10}
    return CameraFile.model_validate(calibration | {"model": model, "distortion": distortion})


def seen_by_lens(points_camera: np.ndarray, camera: CameraFile) -> np.ndarray:
    """Project with OpenCV's own lens model, independently of the code under test."""
    project = cv2.fisheye.projectPoints if camera.model == "fisheye" else cv2.projectPoints
    K, D, zero = Intrinsics.of(camera.pinhole).K, np.array(camera.distortion), np.zeros(3)
    points = points_camera[:, None] if camera.model == "fisheye" else points_camera
    pixels, _ = project(points, zero, zero, K, D)
    return pixels.reshape(-1, 2)


@pytest.mark.parametrize("name", LENSES)
def test_points_land_on_the_pinhole_projection(name: str) -> None:
    camera = lens(name)
    undistortion = Undistortion(camera)
    pixels = undistortion.intrinsics.pixel_grid()[10::20, 10::20].reshape(-1, 2)
    u, v = pixels.astype(int).T
    taken_from = np.column_stack([table[v, u] for table in undistortion._maps])
    seen = seen_by_lens(7.0 * undistortion.intrinsics.rays(pixels), camera)
    np.testing.assert_allclose(taken_from, seen, atol=1e-3)


@pytest.mark.parametrize("name", LENSES)
def test_no_black_border_and_none_to_spare(name: str) -> None:
    undistortion = Undistortion(lens(name))
    white = undistortion.apply(np.full((HEIGHT, WIDTH, 3), 255, np.uint8))
    assert (white == 255).all()
    map_u, map_v = undistortion._maps
    assert map_u.min() >= -1e-3 and map_u.max() <= WIDTH - 1 + 1e-3
    assert map_v.min() >= -1e-3 and map_v.max() <= HEIGHT - 1 + 1e-3
    slack = min(map_u.min(), map_v.min(), WIDTH - 1 - map_u.max(), HEIGHT - 1 - map_v.max())
    assert slack < 0.02 * WIDTH


def test_folding_lens_is_refused_or_cropped() -> None:
    """A radius that runs backwards must not come into the image."""
    camera = lens("barrel").model_copy(update={"distortion": (-0.9, 0.0, 0.0, 0.0)})
    undistortion = Undistortion(camera)
    corner = (np.array([[0.0, 0.0]]) - undistortion.intrinsics.K[:2, 2]) / undistortion.intrinsics.fx
    assert np.linalg.norm(corner) < (1 / (3 * 0.9)) ** 0.5 * 1.03  # where r (1 - 0.9 r^2) is largest
    hopeless = lens("barrel").model_copy(update={"distortion": (400.0, 0.0, 0.0, 0.0)})
    with pytest.raises(SequenceError, match="leaves no image free of black borders"):
        Undistortion(hopeless)
    folded = lens("barrel").model_copy(update={"distortion": (-9.0, 3.0, 0.0, 0.0)})
    with pytest.raises(SequenceError, match=r"distortion \[-9.* folds the image"):
        Undistortion(folded)
