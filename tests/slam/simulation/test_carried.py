from typing import get_args

import numpy as np
import pytest

from slam.geometry import se3
from slam.simulation.carried import FASTEST_TURN_DEG
from slam.simulation.options import Motion, SimulationOptions
from slam.simulation.rooms import SimulatedRooms


def carried(frames: int, motion: Motion | None = None, rate: float = 10.0) -> SimulatedRooms:
    options = SimulationOptions("rooms", frames, 2, 96, 72, motion=motion, rate=rate)
    return SimulatedRooms(options)


def turns_deg(world: SimulatedRooms) -> np.ndarray:
    T_before_after = se3.invert(world.T_world_camera[:-1]) @ world.T_world_camera[1:]
    return np.rad2deg(se3.rotation_angle(T_before_after[:, :3, :3]))


@pytest.mark.parametrize("motion", get_args(Motion))
def test_camera_keeps_clear_of_walls_and_furniture_and_turns_no_faster_than_asked(motion: Motion):
    world = carried(600, motion, 5.0)
    step = np.linalg.norm(np.diff(world.T_world_camera[:, :3, 3], axis=0), axis=1)
    assert world.distance_to_surface(world.T_world_camera[::3, :3, 3]).min() >= 0.3
    assert step.max() < 0.4 and (step.sum() > 20.0) == (motion != "turn")
    assert turns_deg(world).max() < 1.5 * FASTEST_TURN_DEG
    assert se3.is_se3(world.T_world_camera, 1e-9) and np.array_equal(
        world.T_world_camera[0], np.eye(4)
    )


def test_a_higher_rate_takes_more_images_of_slower_turns():
    assert (
        turns_deg(carried(240, "phone", 60.0)).max() < 5.0 < turns_deg(carried(240, rate=5.0)).max()
    )
