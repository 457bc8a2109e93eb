"""A minimal KITTI raw drive with LiDAR."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import small_drives
from numpy.typing import NDArray


@pytest.fixture
def points_at() -> Callable[..., NDArray[np.float32]]:
    return small_drives.points_at


@pytest.fixture
def write_drive() -> Callable[..., Path]:
    return small_drives.write_drive
