from collections.abc import Callable

import numpy as np
import pytest

from slam.config.sections import MappingConfig
from slam.frames import Intrinsics
from slam.geometry import se3
from slam.mapping.depth import KeyframeDepth
from slam.mapping.map import TsdfMap

CAMERA = Intrinsics(208, 64, 120.0, 120.0, 103.5, 31.5)
_V, _U = np.mgrid[: CAMERA.height, : CAMERA.width]
_X, _Y = (_U - CAMERA.cx) / CAMERA.fx, (_V - CAMERA.cy) / CAMERA.fy

StreetMap = Callable[..., TsdfMap]


def _street(z: float) -> np.ndarray:
    """A road 1.65 m below the camera between walls at x = -6 and x = 6; at z = 40 it ends at a wall."""
    with np.errstate(divide="ignore"):
        road = np.where(_Y > 0, 1.65 / _Y, np.inf)
        walls = 6.0 / np.abs(_X)
    return np.minimum(np.minimum(road, walls), 40.0 - z).astype(np.float32)


@pytest.fixture(scope="session")
def street_map() -> StreetMap:
    """A map of some frames, 1 m apart, with images of one grey level each; its unit has ``per_metre`` to a metre."""

    def make(
        grey: Callable[[int], float] = lambda k: 128.0,
        hidden: bool = False,
        per_metre: float = 1.0,
        frames: int = 18,
        darkening: float = 0.0,
        **config: float,
    ) -> TsdfMap:
        settings = MappingConfig(**{"depth_max_m": 20.0, **config}).in_unit(per_metre)
        tsdf_map = TsdfMap(settings, CAMERA)
        for k in range(frames):
            depth = _street(float(k))
            if hidden:  # a hole of the road, 1 m wide, at z = 20
                z = k + depth
                on_road = (depth * _Y > 1.6) & (np.abs(depth * _X) < 0.5) & (np.abs(z - 20.0) < 0.5)
                depth = np.where(on_road, 0, depth).astype(np.float32)
            noise = np.random.default_rng(k).normal(0, 2, (CAMERA.height, CAMERA.width, 1))
            lens = np.exp(darkening * (_X**2 + _Y**2))[..., None]
            image = np.clip(grey(k) * lens + noise, 0, 255).astype(np.uint8).repeat(3, axis=2)
            T_world_camera = se3.make(np.eye(3), np.array([0.0, 0.0, per_metre * k]))
            tsdf_map.integrate(
                KeyframeDepth(k, np.float32(per_metre) * depth, None, image, T_world_camera)
            )
        return tsdf_map

    return make
