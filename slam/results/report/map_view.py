"""Views of a finished map for people: two pictures in the run folder, and the viewer of the report."""

from __future__ import annotations

import io
from dataclasses import dataclass

import cv2

from slam.frames import Image
from slam.results.folder import RunFolder
from slam.results.report.map_mesh import MapMeshFile
from slam.results.report.map_picture import MapScene
from slam.results.report.map_viewer import MapViewer, map_viewer
from slam.results.report.plots import length_unit, map_figure
from slam.runtime.errors import RunError
from slam.runtime.run_files import MAP_ABOVE, MAP_DRIVER, MAP_MESH

_MOST_TRIANGLES = 1_000_000  # of the picture from above
_NEAR = 100.0  # the driver sees that far, in the whole mesh


@dataclass(frozen=True)
class MapViews:
    """The pictures as PNG: ``above``, and ``driver`` from the seat at ``frame``; the viewer, or None."""

    above: bytes
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
    buffer = io.BytesIO()
    figure = map_figure(scene.from_above(trajectory.positions), trajectory, length_unit(folder))
    figure.savefig(buffer, format="png", dpi=160, metadata={"Software": None})
    T_world_camera = trajectory.T_world_camera
    frame = scene.best_seat(T_world_camera)
    near = file.near(T_world_camera[frame, :3, 3], _NEAR)
    driver = (MapScene(near) if len(near.triangles) else scene).from_seat(T_world_camera[frame])
    viewer = map_viewer(mesh.decimated(triangles), T_world_camera, frame) if triangles else None
    views = MapViews(buffer.getvalue(), _png(driver), frame, viewer)
    folder.write(MAP_ABOVE, lambda path: path.write_bytes(views.above))
    folder.write(MAP_DRIVER, lambda path: path.write_bytes(views.driver))
    return views


def _png(image: Image) -> bytes:
    written, content = cv2.imencode(".png", image[..., ::-1])
    if not written:
        raise RunError("a picture of the map cannot be written as PNG")
    return content.tobytes()
