import cv2
import numpy as np
import pytest

from erfsfm.common.readers.camera_file import CameraFile
from slam.frames import Intrinsics
from slam.runtime.errors import SequenceError
from slam.sequences.undistortion import Undistortion

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


def dots(pixels: np.ndarray) -> np.ndarray:
    """An image with a smooth dot at every given pixel (sub-pixel exact)."""
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH]
    image = np.zeros((HEIGHT, WIDTH))
    for x, y in pixels:
        image += np.exp(-((u - x) ** 2 + (v - y) ** 2) / (2 * 2.0**2))
    return np.repeat((np.clip(image, 0, 1) * 255).astype(np.uint8)[..., None], 3, axis=2)


def centroid(image: np.ndarray, near: np.ndarray) -> np.ndarray:
    x, y = np.round(near).astype(int)
    patch = image[y - 7 : y + 8, x - 7 : x + 8, 0].astype(float)
    v, u = np.mgrid[-7:8, -7:8]
    return np.array([(patch * u).sum() + x * patch.sum(), (patch * v).sum() + y * patch.sum()]) / patch.sum()


@pytest.mark.parametrize("name", LENSES)
def test_points_land_on_the_pinhole_projection(name: str) -> None:
    camera = lens(name)
    undistortion = Undistortion(camera)
    K = undistortion.intrinsics.K
    u, v = np.meshgrid(np.linspace(30, WIDTH - 31, 6), np.linspace(30, HEIGHT - 31, 5))
    wanted = np.column_stack([u.ravel(), v.ravel()])
    points_camera = np.column_stack([(wanted - K[:2, 2]) / K[[0, 1], [0, 1]], np.ones(len(wanted))]) * 7.0
    flat = undistortion.apply(dots(seen_by_lens(points_camera, camera)))
    found = np.array([centroid(flat, pixel) for pixel in wanted])
    # the lens also stretches each dot, so centroids move a little
    assert np.abs(found - wanted).max() < 0.25
    rows = found.reshape(5, 6, 2)
    assert np.ptp(rows[..., 1], axis=1).max() < 0.3  # straight lines stay straight
    assert np.ptp(rows[..., 0], axis=0).max() < 0.3


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
