"""What is doubtful after the last frame is said."""

from __future__ import annotations

import numpy as np
import pytest

from slam.frontend.image_gate import ImageGate
from slam.pipeline.checks import warn_of_images


@pytest.mark.parametrize(("rows", "said"), [(0, 0), (10, 1), (70, 2)])
def test_a_mask_that_leaves_little_of_the_world_is_said(
    rows: int, said: int, caplog: pytest.LogCaptureFixture
) -> None:
    fixed = np.zeros((100, 10), bool)
    fixed[:rows] = True
    warn_of_images(ImageGate(), fixed)
    assert len(caplog.records) == said
    assert ("little of the world" in caplog.text) == (said == 2)
