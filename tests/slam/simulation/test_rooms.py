from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from slam.geometry import se3
from slam.results.truth_errors import find_truth
from slam.sequences.catalogue import open_sequence
from slam.simulation.options import SimulationOptions
from slam.simulation.recording import SimulatedSequence, write_kitti_root
from slam.simulation.rooms import SimulatedRooms

SMALL = {"width": 96, "height": 72}


def rooms(frames: int = 60, seed: int = 1, **options: object) -> SimulatedRooms:
    return SimulatedRooms(SimulationOptions("rooms", frames, seed, **(SMALL | options)))  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def walk() -> SimulatedRooms:
    return rooms()


def test_depth_at_true_poses_explains_the_next_depth(walk: SimulatedRooms):
    for k in (5, 30):
        v, u = np.mgrid[0:72, 0:96].reshape(2, -1)
        points = np.linalg.inv(walk.K) @ np.stack([u, v, np.ones_like(u)]) * walk.depth(k).ravel()
        T_next_camera = se3.invert(walk.T_world_camera[k + 1]) @ walk.T_world_camera[k]
        moved = se3.apply(T_next_camera, points.T)
        at = walk.K @ moved.T
        at = at[:2] / at[2]
        inside = ((at > 0) & (at < [[95], [71]])).all(axis=0) & (moved[:, 2] > 0.1)
        seen = map_coordinates(walk.depth(k + 1), at[::-1, inside], order=1)
        assert inside.mean() > 0.3
        assert np.median(np.abs(seen / moved[inside, 2] - 1.0)) < 0.005


def test_depth_is_the_distance_to_the_surface_and_closes_the_room(walk: SimulatedRooms):
    depth = walk.depth(7)
    assert (depth > 0).all() and depth.max() < 50.0
    v, u = np.mgrid[0:72:5, 0:96:5].reshape(2, -1)
    points = (np.linalg.inv(walk.K) @ np.stack([u, v, np.ones_like(u)])).T * depth[v, u][:, None]
    points_world = se3.apply(walk.T_world_camera[7], points)
    assert np.quantile(walk.distance_to_surface(points_world), 0.99) < 1e-3


def test_same_options_give_the_same_bytes_and_other_seeds_another_house(walk: SimulatedRooms):
    again, other = rooms(), rooms(seed=4)
    assert np.array_equal(again.T_world_camera, walk.T_world_camera)
    assert np.array_equal(again.render(9), walk.render(9))
    assert np.abs(other.render(9).astype(float) - walk.render(9)).mean() > 10


@pytest.mark.parametrize("hazard", ["people", "exposure", "blur", "rolling-shutter"])
def test_hazards_change_images_but_not_poses(walk: SimulatedRooms, hazard: str):
    world = rooms(hazards=(hazard,))
    changed = [
        np.abs(world.render(k).astype(float) - walk.render(k)).mean() for k in (5, 20, 40, 55)
    ]
    assert max(changed) > 0.5
    assert np.array_equal(world.T_world_camera, walk.T_world_camera)
    if hazard != "people":
        assert np.array_equal(world.depth(20), walk.depth(20))


def test_people_have_depth():
    empty, peopled = rooms(300, 2), rooms(300, 2, hazards=("people",))
    depths = [(peopled.depth(k), empty.depth(k)) for k in range(0, 300, 12)]
    assert max((with_people < without - 0.05).mean() for with_people, without in depths) > 0.01
    assert not any((with_people > without).any() for with_people, without in depths)


def test_exposure_follows_the_light():
    world = rooms(300, 4, hazards=("exposure",))
    brightness = [world.render(k).mean() for k in range(0, 300, 60)]
    assert np.median(brightness) == pytest.approx(0.4 * 255, rel=0.4)
    assert np.ptp([world._gain(k) for k in range(0, 300, 30)]) > 0.1


def test_a_root_on_disk_has_the_exact_surface(walk: SimulatedRooms, tmp_path: Path):
    short, root = rooms(4, rate=30.0), tmp_path / "world"
    write_kitti_root(short, root, depth=True, mesh=True)
    sequence = open_sequence(root)
    assert (
        sequence.stamps == pytest.approx(np.arange(4) / 30.0) and sequence.camera_height_m is None
    )
    truth, embedded = find_truth(sequence), find_truth(SimulatedSequence(short.options))
    points = np.random.default_rng(0).uniform(-2.0, 2.0, (50, 3))
    for found in (truth, embedded):
        assert (
            not isinstance(found, str)
            and found.name == "exact surface"
            and found.distance is not None
        )
        assert found.distance(points) == pytest.approx(short.distance_to_surface(points), abs=1e-4)
    assert len(truth.view(2).points) == len(embedded.view(2).points) > 1000  # type: ignore[union-attr]
    (root / "mesh.ply").unlink()
    found = find_truth(open_sequence(root))
    assert not isinstance(found, str) and found.name == "depth maps"
