"""Pinhole intrinsics under a resize, and impossible ones."""

from __future__ import annotations

import logging
from dataclasses import replace

import pytest

from erfsfm.common.readers.pinhole import Pinhole, impossible, require_plausible
from erfsfm.geometry.camera import Camera
from slam.frames import Intrinsics

KITTI = Pinhole(1241, 376, 718.856, 718.856, 607.1928, 185.2157)


@pytest.mark.parametrize("kind", [Camera, Intrinsics])
def test_both_packages_resize_in_the_same_way(kind: type[Pinhole]) -> None:
    half = kind.of(Pinhole(100, 60, 80.0, 82.0, 49.5, 29.5)).resized(50, 30)
    assert type(half) is kind
    assert (half.width, half.height, half.fx, half.fy, half.cx, half.cy) == (50, 30, 40, 41, 24.5, 14.5)
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
def test_real_cameras_pass_without_a_warning(camera: Pinhole, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        require_plausible(camera, "here")
    assert impossible(camera) is None and not caplog.records
