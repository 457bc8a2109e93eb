"""Pictures of the report show what they say: corners of a loop on both images, depth in colours."""

from __future__ import annotations

import base64

import cv2
import numpy as np
from numpy.typing import NDArray

from slam.frames import LOOP_SOURCE, RelativePose
from slam.geometry.se3 import from_rotation_vector, invert
from slam.loops.verification import OF_FRAMES, Loop
from slam.mapping.filters import KeyframeDepth
from slam.results.report.page import Picture
from slam.results.report.pictures import DepthPictures, loop_pictures
from slam.sequences.simulated import SimulatedSequence
from slam.simulation.options import SimulationOptions


def pixels(picture: Picture) -> NDArray[np.uint8]:
    """``(H, W, 3)``, BGR."""
    content = base64.b64decode(picture.image.removeprefix("data:image/jpeg;base64,"))
    return np.asarray(cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR))


def test_lines_join_the_corners_that_fit_the_loop() -> None:
    street = SimulatedSequence(SimulationOptions("straight", 40, 1002, 208, 64))
    T_world_camera = street.reference
    images = [street.frame(index).image for index in (4, 6)]
    T_true = invert(T_world_camera[4]) @ T_world_camera[6]
    turned = T_true @ from_rotation_vector(np.array([0.3, 0.0, 0.0]), np.zeros(3))

    def drawn(T: NDArray[np.float64]) -> NDArray[np.uint8]:
        loop = Loop(RelativePose(4, 6, T, np.full(6, 0.1), LOOP_SOURCE), 50, 0.9)
        found = loop_pictures([loop], lambda index: images[(index - 4) // 2], street.intrinsics, OF_FRAMES)
        assert [picture.title for picture in found] == ["Frames 4 and 6: 50 inliers"]
        return pixels(found[0])

    right, wrong = drawn(T_true), drawn(turned)
    assert right.shape == wrong.shape == (2 * 148, 480, 3)
    plain = np.vstack([cv2.resize(image[..., ::-1], (480, 148)) for image in images])
    changed = [(np.abs(shown.astype(int) - plain).max(axis=-1) > 60).mean() for shown in (right, wrong)]
    assert changed[0] > 4 * changed[1]
    gone = loop_pictures([], lambda index: None, street.intrinsics, OF_FRAMES)
    assert gone == []


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
