"""What is simulated: the options of all worlds, which of them a world has, and how streets vary."""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from slam.frames import Intrinsics
from slam.runtime.errors import SequenceError
from slam.simulation.geometry import luck

VERSION = 3  # of the worlds: the same options give the same bytes within a version
_MOST_FRAMES = 100_000
STREET_RATE = 10.0
_MOST_PIXELS = 2**25
_READOUT_S = 0.025  # of a rolling shutter, where frames are far enough apart
_RATES = (5.0, 60.0)

Motion = Literal["walk", "look", "phone", "drone", "robot", "turn"]
Hazard = Literal["moving-cars", "exposure", "blur", "stop", "rain"]
RoomHazard = Literal["people", "exposure", "blur", "rolling-shutter", "stop"]
StreetKind = Literal["town", "avenue", "country", "motorway"]
_ROUTES = ("loop", "grid", "straight", "rooms")
_STREET_SHARES = (0.3, 0.15, 0.35, 0.2)  # of the kinds


@dataclass(frozen=True)
class SimulationOptions:
    """The street or the rooms to simulate; ``seed`` determines everything else.

    A ``varied`` street is a town's, an avenue, a country road or a motorway (`Variety`) with
    another camera than KITTI's, hills, hard light, fences and people, and cars that overtake if
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
        if self.route not in _ROUTES:
            raise SequenceError(f"route must be one of {', '.join(_ROUTES)}; got {self.route!r}")
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
        if not 2 <= self.frames <= _MOST_FRAMES:
            raise SequenceError(f"a drive has 2 to {_MOST_FRAMES:,} frames; got {self.frames:,}")
        if min(self.width, self.height) < 8 or self.width * self.height > _MOST_PIXELS:
            raise SequenceError(
                f"images must be 8 x 8 or larger, of {_MOST_PIXELS:,} pixels at most;"
                f" got {self.width} x {self.height}"
            )

    @property
    def readout_s(self) -> float:
        """The time from the first row of an image to the last: zero unless the shutter rolls."""
        return min(_READOUT_S, 0.9 / self.rate) if "rolling-shutter" in self.hazards else 0.0


@dataclass(frozen=True)
class Variety:
    """One street and its camera."""

    kind: StreetKind  # of street
    # of hills: steepness at most, rise over run, and wavelength, metres; None: gentle ones
    hills: tuple[float, float] | None
    fov_deg: float  # of the camera, horizontal
    # of the camera's own image, which is shrunk to the size asked for; None: of that size
    aspect: float | None
    # of the lens beside the middle of the image, shares of its width and height
    centre: tuple[float, float]
    height_m: float | None  # of the camera above the road at rest; None: as KITTI's
    pitch: float  # of the camera, downwards, radians
    roll: float  # of the camera about its axis, clockwise, radians
    bonnet: float  # share of the image's height that shows the car's own bonnet; 0 shows none
    vignette: float  # share of the light that the corners of the image lack
    noise: float  # of the sensor, standard deviation as a share of white
    blur_px: float  # of the lens, standard deviation

    def camera(self, width: int, height: int) -> Intrinsics:
        """That of images of this size."""
        across = float(0.5 / np.tan(0.5 * np.deg2rad(self.fov_deg)))  # focal length in widths
        fx, fy = across * width, across * (width if self.aspect is None else self.aspect * height)
        cx, cy = (0.5 + self.centre[0]) * width - 0.5, (0.5 + self.centre[1]) * height - 0.5
        return Intrinsics(width, height, fx, fy, cx, cy)


# a town as KITTI odometry 00-02 see theirs (rectified colour camera, 1241 x 376 pixels)
USUAL = Variety(
    kind="town",
    hills=None,
    fov_deg=float(2.0 * np.rad2deg(np.arctan(0.5 * 1241 / 718.856))),
    aspect=1241 / 376,
    centre=(607.6928 / 1241 - 0.5, 185.7157 / 376 - 0.5),
    height_m=None,
    pitch=0.0,
    roll=0.0,
    bonnet=0.0,
    vignette=0.0,
    noise=0.0,
    blur_px=0.55,
)


def draw_variety(seed: int, lone_road: bool) -> Variety:
    """The variety of a seed; only a lone road is a motorway."""
    rng = luck(seed, 5)
    kind: StreetKind = get_args(StreetKind)[rng.choice(4, p=_STREET_SHARES)]
    lowest, highest = (0.5, 2.5) if rng.random() < 0.5 else (1.2, 2.0)
    height_m = float(np.exp(rng.uniform(np.log(lowest), np.log(highest))))
    return Variety(
        kind="country" if kind == "motorway" and not lone_road else kind,
        hills=(rng.uniform(0.0, 0.06 if kind == "motorway" else 0.1), rng.uniform(110.0, 260.0)),
        fov_deg=rng.uniform(50.0, 110.0),
        aspect=rng.uniform(1.0, 3.4) if rng.random() < 0.6 else None,
        centre=(rng.uniform(-0.03, 0.03), rng.uniform(-0.05, 0.05)),
        height_m=height_m,
        pitch=np.deg2rad(rng.uniform(-4.0, 4.0)),
        roll=np.deg2rad(rng.uniform(-2.0, 2.0)),
        bonnet=rng.uniform(0.05, 0.2) if height_m > 1.1 and rng.random() < 0.3 else 0.0,
        vignette=rng.choice([0.0, rng.uniform(0.0, 0.5)]),
        noise=rng.uniform(0.0, 0.012),
        blur_px=rng.uniform(0.25, 0.55),
    )
