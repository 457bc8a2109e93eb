"""Pictures of the report show what they say: corners of a loop on both images, depth in colours."""

from __future__ import annotations

import base64

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from slam.frames import LOOP_SOURCE, Intrinsics, RelativePose
from slam.loops.recognition import Loop
from slam.mapping.filters import KeyframeDepth
from slam.results.report.page import Picture
from slam.results.report.pictures import DepthPictures, loop_pictures


def pixels(picture: Picture) -> NDArray[np.uint8]:
    """``(H, W, 3)``, BGR."""
    content = base64.b64decode(picture.image.removeprefix("data:image/jpeg;base64,"))
    return np.asarray(cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR))


def test_lines_join_the_corners_of_the_loop() -> None:
    first, second = (np.full((64, 208, 3), 128, np.uint8) for _ in range(2))
    camera = Intrinsics(416, 128, 200.0, 200.0, 208.0, 64.0)  # of images twice as large
    corners = np.array([[[104.0, 64.0], [312.0, 32.0]]], np.float32)
    loop = Loop(RelativePose(4, 6, np.eye(4), np.full(6, 0.1), LOOP_SOURCE), 50, 0.9, pixels=corners)
    (picture,) = loop_pictures([loop], {4: first, 6: second}.get, camera)
    assert picture.title == "Frames 4 and 6: 50 inliers"
    shown = pixels(picture).astype(int)
    assert shown.shape == (2 * 148, 480, 3)
    drawn = np.argwhere(np.abs(shown - 128).max(axis=-1) > 60)
    assert drawn.min(axis=0) == pytest.approx([74, 120], abs=4)
    assert drawn.max(axis=0) == pytest.approx([148 + 37, 360], abs=4)
    assert loop_pictures([loop], {4: first}.get, camera) == []  # the image of a live drive is gone


def test_near_is_bright_and_unknown_is_dark() -> None:
    pictures, image = DepthPictures(60), np.full((40, 120, 3), 128, np.uint8)
    learned = np.full((40, 120), 50.0, np.float32)
    refined = learned.copy()
    refined[:, :40], refined[:, 80:] = 2.0, 0.0
    for frame in range(0, 60, 2):
        pictures.add(KeyframeDepth(frame, refined, np.ones_like(refined), image, np.eye(4), learned))
    found = pictures.pictures()
    assert [picture.title for picture in found] == [f"Frame {frame}" for frame in (10, 20, 30, 40, 50)]
    strip = pixels(found[0]).astype(int)
    assert strip.shape == (160, 3 * 480, 3)
    near, far, unknown = (strip[80, 960 + column] for column in (80, 240, 400))
    assert near.mean() > far.mean() + 80
    assert unknown.mean() < 20
