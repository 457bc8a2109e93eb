"""What differs between varied streets: their kind and hills, the camera and how it is mounted."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from slam.frames import Intrinsics

StreetKind = Literal["town", "avenue", "country", "motorway"]

_KINDS: tuple[StreetKind, ...] = ("town", "avenue", "country", "motorway")
_SHARES = (0.3, 0.15, 0.35, 0.2)


@dataclass(frozen=True)
class Variety:
    """One varied street and its camera."""

    kind: StreetKind  # of street
    steepness: float  # of hills at most, rise over run
    wavelength_m: float  # of hills
    fov_deg: float  # of the camera, horizontal
    # of the camera's own image, which is shrunk to the size asked for; None: of that size
    aspect: float | None
    # of the lens beside the middle of the image, shares of its width and height
    centre: tuple[float, float]
    height_m: float  # of the camera above the road at rest
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


def draw_variety(seed: int, lone_road: bool) -> Variety:
    """The variety of a seed; only a lone road is a motorway."""
    rng = np.random.default_rng([seed, 5])
    kind = _KINDS[int(rng.choice(4, p=_SHARES))]
    lowest, highest = (0.5, 2.5) if rng.random() < 0.5 else (1.2, 2.0)
    height_m = float(np.exp(rng.uniform(np.log(lowest), np.log(highest))))
    return Variety(
        kind="country" if kind == "motorway" and not lone_road else kind,
        steepness=float(rng.uniform(0.0, 0.06 if kind == "motorway" else 0.1)),
        wavelength_m=float(rng.uniform(110.0, 260.0)),
        fov_deg=float(rng.uniform(50.0, 110.0)),
        aspect=float(rng.uniform(1.0, 3.4)) if rng.random() < 0.6 else None,
        centre=(float(rng.uniform(-0.03, 0.03)), float(rng.uniform(-0.05, 0.05))),
        height_m=height_m,
        pitch=float(np.deg2rad(rng.uniform(-4.0, 4.0))),
        roll=float(np.deg2rad(rng.uniform(-2.0, 2.0))),
        bonnet=float(rng.uniform(0.05, 0.2)) if height_m > 1.1 and rng.random() < 0.3 else 0.0,
        vignette=float(rng.choice([0.0, rng.uniform(0.0, 0.5)])),
        noise=float(rng.uniform(0.0, 0.012)),
        blur_px=float(rng.uniform(0.25, 0.55)),
    )
