"""``erfsfm-slam calibrate`` on boards rendered with a known camera.

Every pixel's ray is met with the board, twice as fine as the image.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from erfsfm.common.progress import silent
from erfsfm.common.readers.camera_file import CameraFile, read_camera_file
from slam.commands.cli import main
from slam.frames import Intrinsics
from slam.runtime.errors import SlamError
from slam.sequences.calibration import Board, find_views
from slam.sequences.catalogue import open_sequence
from slam.sequences.images import ReadImages

Call = Callable[..., tuple[int, str, str]]
FISHEYE = {"model": "fisheye", "distortion": (-0.02, 0.01, -0.003, 0.0005)}
CHARUCO = {
    "board": Board(9, 6, 0.03, "charuco"),
    "width": 480,
    "height": 360,
    "camera": (390.0, 394.0, 248.0, 175.0),
}
_FINE = 2
_TEXEL_PX = 24  # of the texture, a square
_MARGIN = 1  # squares of white around the board


@dataclass(frozen=True)
class Studio:
    """A camera in front of a board."""

    board: Board = field(default_factory=lambda: Board(9, 6, 0.03))
    model: str = "opencv"
    width: int = 360
    height: int = 270
    camera: tuple[float, ...] = (292.5, 295.5, 186.0, 131.0)
    distortion: tuple[float, ...] = (-0.25, 0.08, 0.0005, -0.0003, 0.0)

    @property
    def K(self) -> np.ndarray:
        fx, fy, cx, cy = self.camera
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])

    def picture(
        self, tilt_deg: tuple[float, float, float], place_m: tuple[float, float, float]
    ) -> np.ndarray:
        """The grey image of the board, turned about its middle, at a place before the camera."""
        R = Rotation.from_euler("xyz", tilt_deg, degrees=True).as_matrix()
        rays = rays_of(self.model, self.width, self.height, self.camera, self.distortion)
        t = np.array(place_m) - R @ self.board.corners_m.mean(axis=0)
        # x, y of the board at the ray's depth: two rows of R^T (z ray - t)
        along = rays @ R
        depth = (R[:, 2] @ t) / along[:, 2]
        squares = (along[:, :2] * depth[:, None] - t @ R[:, :2]) / self.board.square_m + 1 + _MARGIN
        texels = (
            (squares * _TEXEL_PX - 0.5)
            .astype(np.float32)
            .reshape(self.height * _FINE, self.width * _FINE, 2)
        )
        fine = cv2.remap(
            texture(self.board), texels[..., 0], texels[..., 1], cv2.INTER_LINEAR, borderValue=110
        )
        return cv2.resize(fine, (self.width, self.height), interpolation=cv2.INTER_AREA)


@functools.cache
def rays_of(
    model: str, width: int, height: int, camera: tuple[float, ...], distortion: tuple[float, ...]
) -> np.ndarray:
    """Rays ``(N, 3)`` of the fine pixels."""
    step = (np.arange(_FINE) + 0.5) / _FINE - 0.5
    u, v = ((np.arange(size)[:, None] + step).ravel() for size in (width, height))
    pixels = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 1, 2)
    K = np.array([[camera[0], 0, camera[2]], [0, camera[1], camera[3]], [0, 0, 1]])
    undistort = cv2.fisheye.undistortPoints if model == "fisheye" else cv2.undistortPoints
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 1e-8)
    flat = undistort(pixels, K, np.array(distortion), criteria=criteria)
    return np.column_stack([flat.reshape(-1, 2), np.ones(len(pixels))])


@functools.cache
def texture(board: Board) -> np.ndarray:
    columns, rows = board.columns + 1, board.rows + 1
    if board.pattern == "charuco":
        inside = board.charuco().generateImage((columns * _TEXEL_PX, rows * _TEXEL_PX))
    else:
        row, column = np.mgrid[:rows, :columns]
        inside = np.kron(
            255 * ((row + column) % 2).astype(np.uint8), np.ones((_TEXEL_PX,) * 2, np.uint8)
        )
    return np.pad(inside, _MARGIN * _TEXEL_PX, constant_values=255)


def spread(count: int, steepest_deg: float, seed: int = 0, nearest_m: float = 0.42) -> list[tuple]:
    """Tilts and places of the board over the whole image."""
    random = np.random.default_rng(seed)
    views = []
    for k in range(count):
        turn = 2 * np.pi * k / count
        tilt = steepest_deg * (0.4 + 0.6 * random.random())
        z = nearest_m + 0.15 * random.random()
        x, y = 0.26 * z * np.cos(2.4 * k), 0.16 * z * np.sin(2.4 * k)
        views.append(
            ((tilt * np.cos(turn), tilt * np.sin(turn), random.uniform(-20, 20)), (x, y, z))
        )
    return views


def write_views(folder: Path, studio: Studio, views: list[tuple]) -> Path:
    """Pictures of a studio's views in a new folder, with a little noise."""
    folder.mkdir()
    random = np.random.default_rng(1)
    for k, (tilt, place) in enumerate(views):
        picture = studio.picture(tilt, place) + random.normal(0, 2, (studio.height, studio.width))
        cv2.imwrite(str(folder / f"{k:03d}.png"), np.clip(picture, 0, 255).astype(np.uint8))
    return folder


@pytest.fixture
def calibrate(command_line: Call, tmp_path: Path) -> Call:
    """Exit code, stdout and stderr."""
    return partial(
        command_line, main, "erfsfm-slam", "calibrate", "--output", tmp_path / "camera.yaml"
    )


def require_close(camera: CameraFile, studio: Studio) -> None:
    """Focal lengths within 0.5 %, the principal point within 0.5 % of the width, the lens within half a pixel."""
    K = studio.K
    assert camera.fx == pytest.approx(K[0, 0], rel=0.005) and camera.fy == pytest.approx(
        K[1, 1], rel=0.005
    )
    assert (camera.cx, camera.cy) == pytest.approx((K[0, 2], K[1, 2]), abs=0.005 * studio.width)
    grid = np.stack(
        np.meshgrid(np.linspace(-0.5, 0.5, 9), np.linspace(-0.38, 0.38, 7)), axis=-1
    ).reshape(-1, 1, 2)
    points = np.concatenate([grid, np.ones_like(grid[..., :1])], axis=-1)
    project = cv2.fisheye.projectPoints if camera.model == "fisheye" else cv2.projectPoints
    zero = np.zeros(3)
    found, _ = project(
        points, zero, zero, Intrinsics.of(camera.pinhole).K, np.array(camera.distortion)
    )
    true, _ = project(points, zero, zero, K, np.array(studio.distortion))
    assert np.abs(found - true).max() < 0.01 * studio.width


@pytest.mark.parametrize(
    "lens, options",
    [
        ({}, []),
        pytest.param(FISHEYE, ["--model", "fisheye"], marks=pytest.mark.slow),
        pytest.param(CHARUCO, ["--pattern", "charuco"], marks=pytest.mark.slow),
    ],
    ids=["opencv", "fisheye", "charuco"],
)
def test_a_known_camera_is_found(tmp_path: Path, calibrate: Call, lens: dict, options: list[str]):
    studio = Studio(**lens)
    folder = write_views(tmp_path / "board", studio, spread(12, 40))
    code, out, err = calibrate(folder, "--board", "9x6", *options)
    assert code == 0, err
    assert "reprojection error 0." in out and "fps 10 is assumed" in out
    camera = read_camera_file(tmp_path / "camera.yaml")
    require_close(camera, studio)
    assert camera.source is not None and "views of a 9x6" in camera.source
    picture = cv2.imread(str(tmp_path / "camera.png"))
    assert picture is not None and picture.shape == (500, 1300, 3) and picture.std() > 20
    sequence = open_sequence(folder, camera=tmp_path / "camera.yaml")  # run reads it
    assert sequence.frame(0).image.shape == (studio.height, studio.width, 3)


@pytest.mark.slow
def test_among_the_images_the_picture_is_none_of_them(tmp_path: Path, calibrate: Call):
    small = Studio(width=240, height=180, camera=(195.0, 197.0, 124.0, 87.5), distortion=(0.0,) * 5)
    folder = write_views(tmp_path / "board", small, spread(10, 40))
    before = {path: path.read_bytes() for path in folder.iterdir()}
    for _ in range(2):
        code, _, err = calibrate(folder, "--board", "9x6", "--output", folder / "camera.yaml")
        assert code == 0, err
    assert (folder / "camera.pdf").is_file() and not (folder / "camera.png").exists()
    assert all(path.read_bytes() == content for path, content in before.items())
    (folder / "settings.yaml").write_text("mapping: {enabled: false}")
    code, _, err = calibrate(folder, "--board", "9x6", "--output", folder / "settings.yaml")
    assert code == 1 and "settings.yaml is none of ours" in err
    assert (folder / "settings.yaml").read_text() == "mapping: {enabled: false}"
    photo = folder.parent / "camera.png"
    photo.write_bytes(b"what the camera looks like")
    code, _, err = calibrate(folder, "--board", "9x6", "--output", folder.parent / "camera.yaml")
    assert code == 1 and "camera.png is none of ours" in err
    assert photo.read_bytes() == b"what the camera looks like"


@pytest.mark.slow
def test_a_video_gives_its_rate(tmp_path: Path, calibrate: Call):
    studio = Studio(distortion=(0.0,) * 5)
    path = tmp_path / "board.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 25, (360, 270))
    for tilt, place in spread(10, 40):
        writer.write(cv2.cvtColor(studio.picture(tilt, place), cv2.COLOR_GRAY2BGR))
    writer.release()
    code, out, err = calibrate(path, "--board", "9x6", "--square-m", "0.05")
    assert code == 0, err
    camera = read_camera_file(tmp_path / "camera.yaml")
    assert camera.fps == 25 and "assumed" not in out
    require_close(camera, studio)


@pytest.mark.parametrize(
    "views, options, message",
    [
        (
            "frontal",
            [],
            "all 9 views are frontal .*do not determine the focal length; tilt it by 20 to 45",
        ),
        ("few", [], "3 of 3 images show the whole 9x6 chessboard, 8 are needed: take 20 or more"),
        (
            "outside",
            [],
            "0 of 4 images show the whole 9x6 chessboard.*with all of the board in them",
        ),
        pytest.param(
            "tilted",
            ["--board", "8x6"],
            "[012] of 4 images show the whole 8x6 chessboard.*counts the corners",
            marks=pytest.mark.slow,
        ),
        ("far", [], "was seen in .* % of the image alone|leave the focal length uncertain"),
        ("tilted", ["--board", "nine"], "--board nine is no board"),
        (
            "tilted",
            ["--pattern", "charuco", "--dictionary", "9X9_1"],
            "--dictionary 9X9_1 is none of OpenCV's",
        ),
        (
            "tilted",
            ["--pattern", "charuco", "--dictionary", "4X4_50", "--board", "19x9"],
            "has too few markers",
        ),
    ],
)
def test_what_does_not_determine_the_camera_is_refused(
    tmp_path: Path, calibrate: Call, views: str, options: list[str], message: str
):
    chosen = {
        "frontal": lambda: spread(9, 2.0),
        "few": lambda: spread(3, 40),
        "outside": lambda: [(tilt, (0.25, *place[1:])) for tilt, place in spread(4, 5)],
        "tilted": lambda: spread(4, 40),
        "far": lambda: [(tilt, (0.0, 0.0, 0.9)) for tilt, _ in spread(9, 40)],
    }[views]()
    folder = write_views(tmp_path / "board", Studio(distortion=(0.0,) * 5), chosen)
    code, out, err = calibrate(folder, "--board", "9x6", *options)
    assert code == 1 and out == ""
    assert len(err.splitlines()) == 1
    assert re.search(message, err), err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["board"]


def test_after_some_images_without_the_board_it_is_said_what_is_looked_for(
    caplog: pytest.LogCaptureFixture,
):
    """A search of 300 images takes minutes, and the board may have been counted by its squares."""
    images = ReadImages(80, 60, 12, lambda index: np.full((60, 80, 3), 20 * index, np.uint8))
    with pytest.raises(SlamError, match="0 of 12 images show"):
        find_views(images, Board(10, 7), silent)
    (said,) = caplog.messages
    assert "none of 8 images shows the whole 10x7 chessboard" in said and "corners between" in said
