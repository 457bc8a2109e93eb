from pathlib import Path

import numpy as np
import pytest

from slam.runtime.errors import SequenceError
from slam.sequences.catalogue import open_sequence
from slam.sequences.excerpt import Excerpt, frame_range
from slam.sequences.poses import rebased
from slam.sequences.recording import Source


@pytest.mark.parametrize(
    "text, wanted",
    [
        ("0:10", (0, 10)),
        (":4", (0, 4)),
        ("3:", (3, 10)),
        (":", (0, 10)),
        ("-4:-1", (6, 9)),
        (" 2 : 5 ", (2, 5)),
    ],
)
def test_ranges(text: str, wanted: tuple[int, int]) -> None:
    assert frame_range(text, 10) == wanted


def test_excerpt_of_an_excerpt(tmp_path: Path, odometry) -> None:
    odometry(tmp_path, frames=10)
    outer = open_sequence(tmp_path, "00", None, "2:9")
    assert isinstance(outer, Excerpt)
    inner = Excerpt(outer, 1, 4)
    assert len(inner) == 3 and inner.name == "00"
    assert inner.provenance() == ("kitti_odometry/00[3:6]",)
    assert inner.stamps == pytest.approx([0.3, 0.4, 0.5])
    frame = inner.frame(2)
    assert (frame.index, frame.stamp, frame.image[0, 0, 0]) == (2, pytest.approx(0.5), 50)
    assert inner.reference is not None
    assert np.array_equal(inner.reference[0], np.eye(4))
    assert inner.reference[2, :3, 3] == pytest.approx([0, 0, 2])
    with pytest.raises(SequenceError, match="no frame 3 "):
        inner.frame(3)
    with pytest.raises(SequenceError, match="no frames 2:9"):
        Excerpt(inner, 2, 9)


def test_sources_are_clipped_to_the_named_recording() -> None:
    source = Source("kitti_odometry/08", first=-1100, length=4071)
    assert source.label(5177) == "kitti_odometry/08[0:4071]"
    assert source.shifted(2000).label(100) == "kitti_odometry/08[900:1000]"
    assert source.label(1000) is None
    assert Source("simulated/7", first=None).shifted(5).label(3) == "simulated/7"


def test_rebased_is_rigid_and_starts_at_the_identity() -> None:
    rng = np.random.default_rng(0)
    T = np.tile(np.eye(4), (3, 1, 1))
    T[:, :3, 3] = rng.normal(size=(3, 3))
    T[0, 0, 1] = 1e-6  # KITTI writes seven digits
    result = rebased(T)
    assert np.array_equal(result[0], np.eye(4))
    assert result[2, :3, 3] == pytest.approx(T[2, :3, 3] - T[0, :3, 3], abs=1e-5)
