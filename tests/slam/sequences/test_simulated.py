import numpy as np
import pytest

from slam.sequences.simulated import SimulatedSequence
from slam.simulation.options import SimulationOptions


@pytest.fixture(scope="module")
def sequence() -> SimulatedSequence:
    return SimulatedSequence(SimulationOptions(route="straight", frames=20, seed=1001, width=104, height=32))


def test_is_a_sequence(sequence: SimulatedSequence) -> None:
    assert (sequence.name, len(sequence)) == ("sim", 20)
    assert np.allclose(sequence.intrinsics.K, sequence.street.K)
    assert sequence.provenance() == ("simulated/1001",)
    assert sequence.reference is not None and np.array_equal(sequence.reference[0], np.eye(4))
    assert sequence.reference[5, 2, 3] > 2.0  # forward is z
    assert sequence.camera_height_m == pytest.approx(sequence.street.camera_height_m)
    assert not sequence.has_scan(0)


def test_frames_are_those_of_the_street(sequence: SimulatedSequence) -> None:
    frame, truth = sequence.frame(3), sequence.street.render(3)
    assert frame.image.shape == (32, 104, 3) and frame.stamp == pytest.approx(truth.stamp)
    assert np.array_equal(frame.image, truth.image)
    frame.image[:] = 0
    assert np.array_equal(sequence.frame(3).image, truth.image)  # the memory is not the caller's


def test_excerpt_keeps_the_world(sequence: SimulatedSequence) -> None:
    excerpt = sequence.cut(4, 10)
    assert excerpt.provenance() == ("simulated/1001",)
    assert np.array_equal(excerpt.frame(0).image, sequence.frame(4).image)
