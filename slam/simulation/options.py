"""What is simulated: the options of all worlds, and which of them a world has."""

from dataclasses import dataclass
from typing import Literal, get_args

from slam.runtime.errors import SequenceError

VERSION = 2  # of the worlds: the same options give the same bytes within a version
MOST_FRAMES = 100_000
STREET_RATE = 10.0
_MOST_PIXELS = 2**25
_READOUT_S = 0.025  # of a rolling shutter, where frames are far enough apart
_RATES = (5.0, 60.0)

RouteKind = Literal["loop", "grid", "straight"]
Motion = Literal["walk", "look", "phone", "drone", "robot"]
Hazard = Literal["moving-cars", "exposure", "blur", "stop", "rain"]
RoomHazard = Literal["people", "exposure", "blur", "rolling-shutter", "stop"]
WORLD_KINDS: tuple[str, ...] = (*get_args(RouteKind), "rooms")


@dataclass(frozen=True)
class SimulationOptions:
    """The street or the rooms to simulate; ``seed`` determines everything else.

    A ``varied`` street is a town's, an avenue, a country road or a motorway (``variety.py``) with
    another camera than KITTI's, hills, hard light, railings and people, and cars that overtake if
    any move; ``varied`` rooms have another focal length. ``rate``, frames a second, and ``motion``
    are of rooms. ``fov_deg`` is the horizontal field of view of square pixels; None is that of the
    world's own camera.
    """

    route: str = "loop"
    frames: int = 300
    seed: int = 0
    width: int = 416
    height: int = 128
    hazards: tuple[str, ...] = ()
    varied: bool = False
    motion: str | None = None
    rate: float = STREET_RATE
    fov_deg: float | None = None

    def __post_init__(self) -> None:
        """Refuse invalid options.

        Raises:
            SequenceError: names the first option that is invalid, and what it may be.
        """
        if self.route not in WORLD_KINDS:
            raise SequenceError(
                f"route must be one of {', '.join(WORLD_KINDS)}; got {self.route!r}"
            )
        place, known = (
            ("rooms", get_args(RoomHazard))
            if self.route == "rooms"
            else ("a street", get_args(Hazard))
        )
        for hazard in self.hazards:
            if hazard not in known:
                raise SequenceError(f"hazards of {place} are {', '.join(known)}; got {hazard!r}")
        if self.route != "rooms" and (self.motion is not None or self.rate != STREET_RATE):
            raise SequenceError(
                f"a street is driven at {STREET_RATE:g} frames a second:"
                " motion and rate are of rooms"
            )
        if self.motion not in (None, *get_args(Motion)):
            raise SequenceError(
                f"motion must be one of {', '.join(get_args(Motion))}; got {self.motion!r}"
            )
        if not _RATES[0] <= self.rate <= _RATES[1]:
            raise SequenceError(
                f"rate must be {_RATES[0]:g} to {_RATES[1]:g} frames a second; got {self.rate:g}"
            )
        if self.seed < 0:
            raise SequenceError(f"seed must be 0 or more; got {self.seed}")
        if self.frames > MOST_FRAMES:
            raise SequenceError(f"a drive has {MOST_FRAMES:,} frames at most; got {self.frames:,}")
        if min(self.width, self.height) < 8 or self.width * self.height > _MOST_PIXELS:
            raise SequenceError(
                f"images must be 8 x 8 or larger, of {_MOST_PIXELS:,} pixels at most;"
                f" got {self.width} x {self.height}"
            )

    @property
    def readout_s(self) -> float:
        """The time from the first row of an image to the last: zero unless the shutter rolls."""
        return min(_READOUT_S, 0.9 / self.rate) if "rolling-shutter" in self.hazards else 0.0
