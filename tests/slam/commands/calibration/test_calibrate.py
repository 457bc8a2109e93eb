"""``erfsfm-slam calibrate`` on boards rendered with a known camera."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest

from erfsfm.common.readers.camera_file import CameraFile, read_camera_file
from slam.commands.board import Board
from slam.commands.cli import main
from slam.sequences.catalogue import open_sequence

Call = Callable[..., tuple[int, str, str]]
FISHEYE = {"model": "fisheye", "distortion": (-0.02, 0.01, -0.003, 0.0005)}


@pytest.fixture
def calibrate(command_line: Call, tmp_path: Path) -> Call:
    """Exit code, stdout and stderr."""
    return partial(command_line, main, "erfsfm-slam", "calibrate", "--output", tmp_path / "camera.yaml")


def require_close(camera: CameraFile, studio) -> None:
    """Focal lengths within 0.5 %, the principal point within 0.5 % of the width, the lens within half a pixel."""
    K = studio.K
    assert camera.fx == pytest.approx(K[0, 0], rel=0.005) and camera.fy == pytest.approx(K[1, 1], rel=0.005)
    assert (camera.cx, camera.cy) == pytest.approx((K[0, 2], K[1, 2]), abs=0.005 * studio.width)
    grid = np.stack(np.meshgrid(np.linspace(-0.5, 0.5, 9), np.linspace(-0.38, 0.38, 7)), axis=-1).reshape(-1, 1, 2)
    points = np.concatenate([grid, np.ones_like(grid[..., :1])], axis=-1)
    project = cv2.fisheye.projectPoints if camera.model == "fisheye" else cv2.projectPoints
    zero = np.zeros(3)
    found, _ = project(points, zero, zero, np.array(studio_matrix(camera)), np.array(camera.distortion))
    true, _ = project(points, zero, zero, K, np.array(studio.distortion))
    assert np.abs(found - true).max() < 0.01 * studio.width


def studio_matrix(camera: CameraFile) -> list[list[float]]:
    return [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]


@pytest.mark.parametrize(
    "lens, options",
    [({}, []), (FISHEYE, ["--model", "fisheye"]), ({"board": Board(9, 6, 0.03, "charuco")}, ["--pattern", "charuco"])],
    ids=["opencv", "fisheye", "charuco"],
)
def test_a_known_camera_is_found(
    tmp_path: Path, make_studio, make_views, write_views, calibrate: Call, lens: dict, options: list[str]
) -> None:
    studio = make_studio(**lens)
    folder = write_views(studio, make_views(12, 40))
    code, out, err = calibrate(folder, "--board", "9x6", *options)
    assert code == 0, err
    assert "reprojection error 0." in out and "fps 10 is assumed" in out
    camera = read_camera_file(tmp_path / "camera.yaml")
    require_close(camera, studio)
    assert camera.source is not None and "views of a 9x6" in camera.source
    picture = cv2.imread(str(tmp_path / "camera.png"))
    assert picture is not None and picture.shape == (500, 1300, 3) and picture.std() > 20
    sequence = open_sequence(folder, camera=tmp_path / "camera.yaml")  # run reads it
    assert sequence.frame(0).image.shape == (360, 480, 3)


def test_among_the_images_the_picture_is_none_of_them(make_studio, make_views, write_views, calibrate: Call) -> None:
    small = make_studio(width=240, height=180, camera=(195.0, 197.0, 124.0, 87.5), distortion=(0.0,) * 5)
    folder = write_views(small, make_views(12, 40))
    before = {path: path.read_bytes() for path in folder.iterdir()}
    for _ in range(2):
        code, _, err = calibrate(folder, "--board", "9x6", "--output", folder / "camera.yaml")
        assert code == 0, err
    assert (folder / "camera.pdf").is_file() and not (folder / "camera.png").exists()
    code, _, err = calibrate(folder, "--board", "9x6", "--output", folder / "new.yaml")
    assert code == 0 and all(path.read_bytes() == content for path, content in before.items())
    (folder / "settings.yaml").write_text("mapping: {enabled: false}")
    code, _, err = calibrate(folder, "--board", "9x6", "--output", folder / "settings.yaml")
    assert code == 1 and "settings.yaml exists and is no camera file" in err
    assert (folder / "settings.yaml").read_text() == "mapping: {enabled: false}"
    photo = folder.parent / "camera.png"
    photo.write_bytes(b"what the camera looks like")
    code, _, err = calibrate(folder, "--board", "9x6", "--output", folder.parent / "camera.yaml")
    assert code == 1 and "camera.png exists and is of no earlier calibration" in err
    assert photo.read_bytes() == b"what the camera looks like"


def test_a_video_gives_its_rate(tmp_path: Path, make_studio, make_views, calibrate: Call) -> None:
    studio = make_studio(distortion=(0.0,) * 5)
    path = tmp_path / "board.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 25, (480, 360))
    for tilt, place in make_views(10, 40):
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
        ("frontal", [], "all 9 views are frontal .*do not determine the focal length; tilt it by 20 to 45"),
        ("few", [], "3 of 3 images show the whole 9x6 chessboard, 8 are needed: take 20 or more"),
        ("outside", [], "0 of 4 images show the whole 9x6 chessboard.*with all of the board in them"),
        ("tilted", ["--board", "8x6"], "[012] of 4 images show the whole 8x6 chessboard.*counts the corners between"),
        ("far", [], "was seen in .* % of the image alone|leave the focal length uncertain"),
        ("tilted", ["--board", "nine"], "--board nine is no board"),
        ("tilted", ["--pattern", "charuco", "--dictionary", "9X9_1"], "--dictionary 9X9_1 is none of OpenCV's"),
        ("tilted", ["--pattern", "charuco", "--dictionary", "4X4_50", "--board", "19x9"], "has too few markers"),
    ],
)
def test_what_does_not_determine_the_camera_is_refused(
    tmp_path: Path, make_studio, make_views, write_views, calibrate: Call, views: str, options: list[str], message: str
) -> None:
    chosen = {
        "frontal": lambda: make_views(9, 2.0),
        "few": lambda: make_views(3, 40),
        "outside": lambda: [(tilt, (0.25, *place[1:])) for tilt, place in make_views(4, 5)],
        "tilted": lambda: make_views(4, 40),
        "far": lambda: [(tilt, (0.0, 0.0, 0.9)) for tilt, _ in make_views(9, 40)],
    }[views]()
    folder = write_views(make_studio(distortion=(0.0,) * 5), chosen)
    code, out, err = calibrate(folder, "--board", "9x6", *options)
    assert code == 1 and out == ""
    assert len(err.splitlines()) == 1
    assert re.search(message, err), err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["board"]
