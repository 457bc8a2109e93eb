"""Pictures of a finished map by ray casting, without a display: from above, and from the driver's seat."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.frames import Image
from slam.geometry.se3 import FloatArray
from slam.results.report.map_mesh import MapMesh
from slam.runtime.imports import import_open3d

WIDTH_PX, HEIGHT_PX = 1280, 720
FIELD_OF_VIEW_DEG = 55.0  # of the height, 85 of the width
BACKGROUND = (226, 232, 239)
_ABOVE_PX = 1100
_CANDIDATES = 9
_SMALL = 16
_SEEN_WITHIN = 40.0
_EDGE = 0.04
_FEW_PERCENT = (0.5, 99.5)


@dataclass(frozen=True)
class AerialView:
    """The map seen straight from above: ``image`` ``(H, W, 4)`` uint8 RGBA, z ahead is up, and its limits."""

    image: NDArray[np.uint8]
    x: tuple[float, float]
    z: tuple[float, float]


class MapScene:
    """A mesh to cast rays at."""

    def __init__(self, mesh: MapMesh) -> None:
        """Build the tree of its triangles."""
        o3d = import_open3d()
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(mesh.points.astype(np.float32), mesh.triangles.astype(np.uint32))
        self._mesh = mesh

    def from_above(self, positions: FloatArray) -> AerialView:
        """The map with the drive through it, from above.

        Args:
            positions: of the cameras, ``(N, 3)``, inside the picture whatever the map is.
        """
        points = self._mesh.points
        corners = np.concatenate([np.percentile(points, _FEW_PERCENT, axis=0), positions])[:, [0, 2]]
        low, high = corners.min(axis=0), corners.max(axis=0)
        margin = _EDGE * float((high - low).max()) or 1.0
        low, high = low - margin, high + margin
        pixel = float((high - low).max()) / _ABOVE_PX
        width, height = np.ceil((high - low) / pixel).astype(int)
        x, z = np.meshgrid(low[0] + pixel * (np.arange(width) + 0.5), high[1] - pixel * (np.arange(height) + 0.5))
        origins = np.stack([x, np.full_like(x, points[:, 1].min() - 1.0), z], axis=-1)
        colours, distance = self._cast(origins, np.broadcast_to([0.0, 1.0, 0.0], origins.shape))
        opaque = np.where(np.isfinite(distance), 255, 0).astype(np.uint8)
        image = np.concatenate([colours, opaque[..., None]], axis=-1)
        return AerialView(image, (low[0], low[0] + width * pixel), (high[1] - height * pixel, high[1]))

    def best_seat(self, T_world_camera: FloatArray) -> int:
        """The one of nine frames, evenly spread over a drive ``(N, 4, 4)``, before which most of the map stands."""
        rows = np.unique(np.linspace(0, len(T_world_camera) - 1, _CANDIDATES + 2)[1:-1].round().astype(int))
        shares = []
        for row in rows:
            _, distance = self._perspective(T_world_camera[row], WIDTH_PX // _SMALL, HEIGHT_PX // _SMALL)
            shares.append(float((distance < _SEEN_WITHIN).mean()))
        return int(rows[int(np.argmax(shares))])

    def from_seat(self, T_world_camera: FloatArray) -> Image:
        """The map as a camera at this pose ``(4, 4)`` sees it, ``(720, 1280, 3)`` uint8 RGB."""
        colours, distance = self._perspective(T_world_camera, WIDTH_PX, HEIGHT_PX)
        return np.where(np.isfinite(distance)[..., None], colours, np.array(BACKGROUND, np.uint8))

    def _perspective(self, T_world_camera: FloatArray, width: int, height: int) -> tuple[Image, NDArray[np.float32]]:
        focal = 0.5 * height / np.tan(np.deg2rad(0.5 * FIELD_OF_VIEW_DEG))
        u, v = np.meshgrid(np.arange(width) - 0.5 * (width - 1), np.arange(height) - 0.5 * (height - 1))
        rays = np.stack([u / focal, v / focal, np.ones_like(u)], axis=-1) @ T_world_camera[:3, :3].T
        return self._cast(np.broadcast_to(T_world_camera[:3, 3], rays.shape), rays)

    def _cast(self, origins: FloatArray, directions: FloatArray) -> tuple[Image, NDArray[np.float32]]:
        """Colours ``(H, W, 3)`` and distances ``(H, W)`` along rays, infinite where they hit nothing."""
        o3d = import_open3d()
        rays = np.concatenate([origins, directions], axis=-1).astype(np.float32)
        hit: dict[str, Any] = self._scene.cast_rays(o3d.core.Tensor(rays))
        distance: NDArray[np.float32] = hit["t_hit"].numpy()
        reached = np.isfinite(distance)
        corners = self._mesh.triangles[hit["primitive_ids"].numpy()[reached]]
        u, v = hit["primitive_uvs"].numpy()[reached].T
        weights = np.stack([1.0 - u - v, u, v], axis=1)
        colours = np.zeros((*distance.shape, 3), np.uint8)
        mixed = np.einsum("pc,pcr->pr", weights, self._mesh.colours[corners].astype(np.float32))
        colours[reached] = np.clip(np.rint(mixed), 0, 255).astype(np.uint8)
        return colours, distance
