"""Camera poses over time: a drive along a street plan, with a car's speed, sway and lane keeping."""

from dataclasses import dataclass

import numpy as np

from slam.errors import SequenceError
from slam.sequences.simulation.geometry import Bend, FloatArray
from slam.sequences.simulation.streets import StreetPlan

STEP = 0.25  # between samples of a path, metres
OVERLAP = 68.0  # how far a loop drives its own start again, metres
START = 25.0  # of a lone road, so that there is something behind the camera, metres
CRUISE = 1.15  # metres per frame
SLOWEST, FASTEST = 0.5, 1.4  # metres per frame
LATERAL_ACCELERATION = 0.045  # in corners, metres per frame squared (4.5 m/s^2)
ACCELERATION = 0.022  # along the road, metres per frame squared


@dataclass(frozen=True)
class Drive:
    """Where the camera is at each frame.

    Attributes:
        plan: the streets.
        bend: from plan to street coordinates.
        T_street_camera: ``(N, 4, 4)``.
        camera_height_m: of the camera at rest above the road.
        lane_plan: the driven path in plan coordinates every ``STEP`` metres, ``(M, 2)``.
    """

    plan: StreetPlan
    bend: Bend
    T_street_camera: FloatArray
    camera_height_m: float
    lane_plan: FloatArray


def plan_drive(route: str, frames: int, seed: int, still_frames: int = 0) -> Drive:
    """Lay out streets and drive over them in ``frames`` frames.

    Args:
        route: ``loop``, ``grid`` or ``straight``.
        frames: how many poses.
        seed: decides everything.
        still_frames: how long to stand still in the middle.

    Raises:
        SequenceError: if there are too few frames for the route.
    """
    moving = frames - still_frames
    if moving < 2:
        raise SequenceError(f"a route needs at least {2 + still_frames} frames here; got {frames}")
    plan, bend, path_plan = _layout(route, moving, seed, stops=still_frames > 0)
    rng = np.random.default_rng([seed, 2])
    path, speed = _speed(bend, path_plan, stops=still_frames > 0)
    times = np.concatenate([[0.0], np.cumsum(2.0 * STEP_LENGTH(path) / (speed[1:] + speed[:-1]))])
    if route == "loop":
        times *= (moving - 1.0) / times[-1]
    sample = np.interp(np.arange(moving), times, np.arange(len(times)))
    height = float(rng.uniform(1.5, 1.8))
    T_street_camera = _poses(rng, bend, path_plan, sample, height)
    if still_frames:
        rest = int(np.argmin(np.diff(sample)))
        T_street_camera = np.insert(T_street_camera, [rest] * still_frames, T_street_camera[rest], axis=0)
    return Drive(plan, bend, T_street_camera, height, path_plan)
