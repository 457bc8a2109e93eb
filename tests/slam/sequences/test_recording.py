import numpy as np
import pytest

from slam.sequences.poses import rebased
from slam.sequences.recording import Source, frame_range
from slam.simulation.options import SimulationOptions
from slam.simulation.recording import SimulatedSequence


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
def test_ranges(text: str, wanted: tuple[int, int]):
    assert frame_range(text, 10) == wanted


def test_sources_are_clipped_to_the_named_recording():
    source = Source("kitti_odometry/08", first=-1100, length=4071)
    assert source.label(5177) == "kitti_odometry/08[0:4071]"
    assert source.shifted(2000).label(100) == "kitti_odometry/08[900:1000]"
    assert source.label(1000) is None
    assert Source("simulated/7", first=None).shifted(5).label(3) == "simulated/7"


def test_rebased_is_rigid_and_starts_at_the_identity():
    rng = np.random.default_rng(0)
    T = np.tile(np.eye(4), (3, 1, 1))
    T[:, :3, 3] = rng.normal(size=(3, 3))
    T[0, 0, 1] = 1e-6  # KITTI writes seven digits
    result = rebased(T)
    assert np.array_equal(result[0], np.eye(4))
    assert result[2, :3, 3] == pytest.approx(T[2, :3, 3] - T[0, :3, 3], abs=1e-5)


@pytest.fixture(scope="module")
def simulated() -> SimulatedSequence:
    return SimulatedSequence(
        SimulationOptions(route="straight", frames=20, seed=1001, width=104, height=32)
    )


def test_is_a_sequence(simulated: SimulatedSequence):
    assert (simulated.name, len(simulated)) == ("sim", 20)
    assert np.allclose(simulated.intrinsics.K, simulated.street.K)
    assert simulated.provenance() == ("simulated/1001",)
    assert simulated.reference is not None and np.array_equal(simulated.reference[0], np.eye(4))
    assert simulated.reference[5, 2, 3] > 2.0  # forward is z
    assert simulated.camera_height_m == pytest.approx(simulated.street.camera_height_m)
    assert not simulated.has_scan(0)


def test_frames_are_those_of_the_street(simulated: SimulatedSequence):
    frame, truth = simulated.frame(3), simulated.street.render(3)
    assert frame.image.shape == (32, 104, 3) and frame.stamp == pytest.approx(0.3)
    assert np.array_equal(frame.image, truth)
    frame.image[:] = 0
    assert np.array_equal(simulated.frame(3).image, truth)  # the memory is not the caller's


def test_excerpt_keeps_the_world(simulated: SimulatedSequence):
    excerpt = simulated.cut(4, 10)
    assert excerpt.provenance() == ("simulated/1001",)
    assert np.array_equal(excerpt.frame(0).image, simulated.frame(4).image)
