"""What a scale mode needs of a sequence, and the metres that it knows."""

import numpy as np
import pytest

from slam.config.sections import ScaleConfig
from slam.frames import Intrinsics
from slam.frontend.scale_mode import scale_from_reference, unit_of
from slam.runtime.errors import Failed
from slam.sequences.images import ReadImages
from slam.sequences.recording import RecordedSequence


def test_reference_compares_the_first_path_lengths():
    true = np.tile(np.eye(4), (100, 1, 1))
    true[:, 2, 3] = np.arange(100)
    unscaled = true.copy()
    unscaled[:50, 2, 3] *= 0.25
    estimate = scale_from_reference(true, unscaled)
    assert estimate.value == pytest.approx(4.0)
    assert estimate.frames_used == 50
    assert isinstance(scale_from_reference(true, true * 0 + np.eye(4)), Failed)


@pytest.mark.parametrize(
    ("configured", "height", "mode"),
    [
        ("auto", 1.65, "camera-height"),
        ("auto", None, "none"),
        ("none", 1.65, "none"),
        ("reference", None, "reference"),
        ("lidar", 1.65, "lidar"),
    ],
)
def test_auto_stands_for_camera_height_where_it_is_known(configured, height, mode):
    sequence = RecordedSequence(
        "drawn",
        ReadImages(8, 8, 2, lambda index: np.zeros((8, 8, 3), np.uint8)),
        Intrinsics(8, 8, 8.0, 8.0, 4.0, 4.0),
        np.array([0.0, 0.1]),
        (),
        T_any_camera=np.tile(np.eye(4), (2, 1, 1)),
        usual_height_m=height,
        T_camera_lidar=np.eye(4),
        scans=dict.fromkeys(range(2), lambda: np.zeros((1, 3))),
    )
    assert unit_of(ScaleConfig(mode=configured), sequence).mode == mode
