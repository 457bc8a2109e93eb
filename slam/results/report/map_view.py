"""Views of a finished map for people: two pictures by ray casting in the run folder, and the viewer of the report."""

from __future__ import annotations

import json
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slam.frames import Image
from slam.geometry.se3 import FloatArray
from slam.results.folder import RunFolder
from slam.results.report.map_mesh import MapMesh, MapMeshFile
from slam.results.report.plots import AerialView, length_unit, map_figure
from slam.results.report.rendering import packed
from slam.runtime.errors import RunError
from slam.runtime.imports import import_open3d
from slam.runtime.run_files import MAP_ABOVE, MAP_DRIVER, MAP_MESH

WIDTH_PX, HEIGHT_PX = 1280, 720
FIELD_OF_VIEW_DEG = 55.0  # of the height, 85 of the width
BACKGROUND = (226, 232, 239)
_ABOVE_PX = 1100
_CANDIDATES = 9
_SMALL = 16
_SEEN_WITHIN = 40.0
_EDGE = 0.04
_FEW_PERCENT = (0.5, 99.5)
_MOST_TRIANGLES = 1_000_000  # of the picture from above
_NEAR = 100.0  # the driver sees that far, in the whole mesh
_MOST_OF_PATH = 2000
_AHEAD = 12.0  # what the view turns about, before the driver
_Y_UP = np.array([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class MapViewer:
    """Parts of the page: ``about`` as JSON, ``mesh`` and the library ``three`` as base64 of gzip, ``script``."""

    about: str
    mesh: str
    three: str
    script: str


@dataclass(frozen=True)
class MapViews:
    """The map from ``above``, the picture of the ``driver`` at ``frame`` as PNG, and the viewer or None."""

    above: AerialView
    driver: bytes
    frame: int
    viewer: MapViewer | None


def write_map_views(folder: RunFolder, triangles: int) -> MapViews | None:
    """Write ``map_above.png`` and ``map_driver.png``; None without ``map_mesh.ply``.

    Args:
        folder: a run with its map and its optimised trajectory.
        triangles: most of the viewer's mesh; 0 leaves the viewer out.

    Raises:
        RunError: the mesh is damaged, or a picture cannot be written.
    """
    trajectory = folder.trajectory("optimised")
    if trajectory is None or not (folder.path / MAP_MESH).is_file():
        return None
    file = MapMeshFile(folder.path / MAP_MESH)
    mesh = file.reduced(_MOST_TRIANGLES)
    scene = MapScene(mesh)
    above = scene.from_above(trajectory.positions)
    figure = map_figure(above, trajectory, length_unit(folder))
    T_world_camera = trajectory.T_world_camera
    frame = scene.best_seat(T_world_camera)
    if file.triangles > _MOST_TRIANGLES:  # the driver sees the mesh as it is
        near = file.near(T_world_camera[frame, :3, 3], _NEAR)
        scene = MapScene(near) if len(near.triangles) else scene
    driver = scene.from_seat(T_world_camera[frame])
    viewer = map_viewer(mesh.decimated(triangles), T_world_camera, frame) if triangles else None
    views = MapViews(above, _png(driver), frame, viewer)
    folder.write(MAP_ABOVE, lambda path: figure.savefig(path, format="png", dpi=160, metadata={"Software": None}))
    folder.write(MAP_DRIVER, lambda path: path.write_bytes(views.driver))
    return views


def _png(image: Image) -> bytes:
    written, content = cv2.imencode(".png", image[..., ::-1])
    if not written:
        raise RunError("a picture of the map cannot be written as PNG")
    return content.tobytes()


class MapScene:
    """A mesh to cast rays at, without a display."""

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


def map_viewer(mesh: MapMesh, T_world_camera: FloatArray, seat: int) -> MapViewer:
    """Pack a mesh with the drive through it.

    Args:
        mesh: of the map, y down; in the page y is up.
        T_world_camera: poses of the drive, ``(N, 4, 4)``.
        seat: the frame from which the map is seen first.
    """
    first, corners = _by_first_use(mesh)
    points = mesh.points[first] * _Y_UP
    low = points.min(axis=0)
    step = np.maximum((points.max(axis=0) - low) / 65535.0, 1e-9)
    content = np.rint((points - low) / step).astype("<u2").tobytes() + mesh.colours[first].tobytes()
    padding = -len(content) % 4
    content += bytes(padding) + np.diff(corners.ravel(), prepend=0).astype("<i4").tobytes()
    rows = np.linspace(0, len(T_world_camera) - 1, min(len(T_world_camera), _MOST_OF_PATH)).round().astype(int)
    position = T_world_camera[seat, :3, 3]
    ahead = position + _AHEAD * T_world_camera[seat, :3, 2]
    about = {
        "vertices": len(points),
        "triangles": len(corners),
        "padding": padding,
        "low": low.tolist(),
        "step": step.tolist(),
        "path": (T_world_camera[rows, :3, 3] * _Y_UP).round(3).ravel().tolist(),
        "seat": (position * _Y_UP).tolist(),
        "ahead": (ahead * _Y_UP).tolist(),
        "field_of_view_deg": FIELD_OF_VIEW_DEG,
        "background": "#" + bytes(BACKGROUND).hex(),
    }
    script, three = (files("slam.results.report") / "viewer" / name for name in ("viewer.js", "three.min.js"))
    return MapViewer(json.dumps(about), packed(content), packed(three.read_bytes()), script.read_text("utf-8"))


def _by_first_use(mesh: MapMesh) -> tuple[np.ndarray, np.ndarray]:
    """Vertices in the order of the triangles, and the triangles by their new numbers, which then differ little."""
    triangles = mesh.triangles[np.lexsort(np.sort(mesh.triangles, axis=1).T[::-1])]
    used, first, inverse = np.unique(triangles, return_index=True, return_inverse=True)
    order = np.argsort(first)
    number = np.empty(len(used), dtype=np.int64)
    number[order] = np.arange(len(used))
    return used[order], number[inverse].reshape(-1, 3)
