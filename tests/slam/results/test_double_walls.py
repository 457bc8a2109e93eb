"""Double walls of two passes, by the trajectories before and after a loop was closed."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from slam.config.sections import MappingConfig, ScaleMode
from slam.formats.trajectory import Trajectory
from slam.frames import Intrinsics, RelativePose
from slam.frontend.failure import MeasurementFailure
from slam.frontend.scale.metric_scale import LengthUnit, Scale
from slam.frontend.scale.scale_estimate import ScaleEstimate
from slam.loops.closure import LoopClosures
from slam.loops.verification import Loop
from slam.mapping.filters import KeyframeDepth
from slam.mapping.map import TsdfMap
from slam.results.double_walls import double_walls_at_loops
from slam.results.folder import RunFolder
from slam.results.map import write_map
from slam.runtime.timing import Stopwatch

CAMERA = Intrinsics(208, 64, 120.0, 120.0, 103.5, 31.5)
PASS = 11  # frames, a metre apart
WALL_M = 6.0


def passes(drift_m: float) -> Trajectory:
    """The same road twice; the second pass lies ``drift_m`` to the right."""
    T_world_camera = np.tile(np.eye(4), (2 * PASS, 1, 1))
    T_world_camera[:, 2, 3] = np.tile(np.arange(PASS), 2)
    T_world_camera[PASS:, 0, 3] = drift_m
    return Trajectory(np.arange(2.0 * PASS), T_world_camera)


def fused(trajectory: Trajectory, first: int = 0) -> TsdfMap:
    """Between two walls; a submap a pass."""
    rays = CAMERA.rays(CAMERA.pixel_grid())
    depth = (WALL_M / np.maximum(np.abs(rays[..., 0]), 1e-6)).astype(np.float32)
    grey = np.full((CAMERA.height, CAMERA.width, 3), 128, np.uint8)
    tsdf_map = TsdfMap(MappingConfig(submap_m=PASS - 1.0), CAMERA)
    for frame, T_world_camera in enumerate(trajectory.T_world_camera, first):
        tsdf_map.integrate(KeyframeDepth(frame, depth, None, grey, T_world_camera))
    assert tsdf_map.surface().submaps == 2
    return tsdf_map


def loops(*ends: tuple[int, int]) -> LoopClosures:
    return LoopClosures(accepted=tuple(Loop(RelativePose(*e, np.eye(4), np.ones(6), "loop"), 50, 1.0) for e in ends))


def test_walls_of_two_passes_stand_apart_before_their_loop_is_closed() -> None:
    closed = passes(0.0)
    found = double_walls_at_loops(fused(closed), loops((3, 5), (3, PASS + 3)), passes(1.0), closed)
    shares = found["double_wall_share_at_loops"]
    assert shares["after"] < 0.01
    assert 0.3 < shares["before"] < 0.6  # the right wall of one pass stands before the other's, the left one behind


def test_a_loop_from_before_the_map_joins_no_submaps() -> None:
    """Of a continued run whose earlier keyframes were not kept, the map begins in its middle."""
    later, earlier = 100, 5
    poses = np.concatenate([np.tile(np.eye(4), (later, 1, 1)), passes(0.0).T_world_camera])
    trajectory = Trajectory(np.arange(float(len(poses))), poses)
    tsdf_map = fused(passes(0.0), later)
    for before_map, ends in ((True, (earlier, later + PASS + 3)), (False, (later + 3, later + PASS + 3))):
        found = double_walls_at_loops(tsdf_map, loops(ends), trajectory, trajectory)
        assert (found["double_wall_share_at_loops"] is None) == before_map


def test_without_a_loop_between_submaps_there_is_a_reason() -> None:
    closed = passes(0.0)
    found = double_walls_at_loops(fused(closed), loops((3, 5)), passes(1.0), closed)
    assert found["double_wall_share_at_loops"] is None
    assert "no loop joins" in found["double_wall_share_at_loops_reason"]


@pytest.mark.parametrize(
    ("mode", "estimate", "unit"),
    [
        ("camera-height", ScaleEstimate(1.0, 0.0, 9), "metres"),
        ("none", ScaleEstimate(1.0, 0.0, 9), "camera heights"),
        ("gps", MeasurementFailure("the track is too short"), "camera heights"),
    ],
)
def test_without_metres_there_are_no_double_walls(
    tmp_path: Path, mode: ScaleMode, estimate: ScaleEstimate | MeasurementFailure, unit: LengthUnit
) -> None:
    closed = passes(0.0)
    result = SimpleNamespace(
        map=fused(closed),
        loops=loops((3, PASS + 3)),
        odometry=passes(1.0),
        optimised=closed,
        scale=Scale(mode, estimate, np.ones(2 * PASS), {}, unit),
        stopwatch=Stopwatch(),
    )
    numbers = write_map(RunFolder(tmp_path), result, SimpleNamespace(reference=None))
    for name in ("double_wall_share", "double_wall_share_at_loops"):
        assert (numbers[name] is not None) == (unit == "metres")
        assert numbers.get(f"{name}_reason") == (None if unit == "metres" else "lengths are not in metres")
