"""``camera.yaml``: its keys, and the errors of implausible values."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import pytest

from erfsfm.common.errors import DataError
from erfsfm.common.readers.camera_file import (
    Pinhole,
    impossible,
    read_camera_file,
    require_plausible,
)
from erfsfm.geometry import Camera
from slam.frames import Intrinsics


@pytest.fixture
def camera_yaml() -> str:
    return "width: 40\nheight: 24\nfx: 30\nfy: 30\ncx: 20\ncy: 12\nfps: 5\n"


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "camera.yaml"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    "line, height", [("", 1.65), ("camera_height_m: unknown", None), ("camera_height_m: 1.2", 1.2)]
)
def test_reads(tmp_path: Path, camera_yaml: str, line: str, height: float | None):
    camera = read_camera_file(written(tmp_path, camera_yaml + line))
    assert (camera.pinhole.fx, camera.pinhole.cy, camera.fps) == (30, 12, 5)
    assert camera.height_or(1.65) == height
    assert not camera.is_distorted


@pytest.mark.parametrize(
    "text, message",
    [
        ("", "holds no keys: a camera file needs width"),
        ("width: [", "is not YAML"),
        ("width: 40\n", "height: missing"),
        ("{yaml}focal: 3\n", "focal: unknown key"),
        ("{yaml}camera_height_m: -1\n", "camera_height_m: must be metres above the road"),
        ("{yaml}camera_height_m: 165\n", "greater than 0, to 100, or 'unknown', is 165"),
        ("{yaml}readout_ms: 201\n", "readout_ms: at most 200, the time of a frame; is 201"),
        ("{yaml}model: omni\n", "model: Input should be 'pinhole', 'opencv', 'fisheye' or 'fov'"),
        ("{yaml}distortion: [0.1, 0, 0, 0]\n", "distortion: needs model opencv, fisheye or fov"),
        (
            "{yaml}model: opencv\ndistortion: [0.1]\n",
            "model opencv has 4 or 5 or 8 or 12 or 14 numbers, not 1",
        ),
        ("{yaml}model: fisheye\n", "model fisheye has 4 numbers, not 0"),
    ],
)
def test_errors_are_one_line_and_name_the_key(
    tmp_path: Path, camera_yaml: str, text: str, message: str
):
    path = written(tmp_path, text.replace("{yaml}", camera_yaml))
    with pytest.raises(DataError) as caught:
        read_camera_file(path)
    assert message in str(caught.value)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


KITTI = Pinhole(1241, 376, 718.856, 718.856, 607.1928, 185.2157)


@pytest.mark.parametrize("kind", [Camera, Intrinsics])
def test_both_packages_resize_in_the_same_way(kind: type[Pinhole]):
    half = kind.of(Pinhole(100, 60, 80.0, 82.0, 49.5, 29.5)).resized(50, 30)
    assert type(half) is kind
    assert (half.width, half.height, half.fx, half.fy, half.cx, half.cy) == (
        50,
        30,
        40,
        41,
        24.5,
        14.5,
    )
    assert half.K[0].tolist() == [40, 0, 24.5]


@pytest.mark.parametrize(
    "camera",
    [
        KITTI,
        replace(KITTI, fx=15 * 1241, fy=15 * 1241),
        Pinhole(1280, 720, 200, 200, 640, 360),
        Pinhole(720, 1280, 1000, 1000, 360, 640),
    ],
    ids=["KITTI", "telephoto", "fisheye", "upright"],
)
def test_real_cameras_pass_without_a_warning(camera: Pinhole, caplog: pytest.LogCaptureFixture):
    with caplog.at_level(logging.WARNING):
        require_plausible(camera, "here")
    assert impossible(camera) is None and not caplog.records
