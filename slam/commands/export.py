"""Parts of a run as files for other programs: its map, an occupancy grid, images with poses and points.

The occupancy grid, for ROS, is free where the ground along a drive is seen, occupied where something stands on it.
"""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from erfsfm.common.errors import ErfsfmError
from erfsfm.common.files import refuse_foreign
from erfsfm.common.progress import Progress, silent
from slam.formats.colmap import BINARY_FOLDER, HEADER, MODEL_FILES, Sightings, write_colmap
from slam.formats.ply import R_UP_WORLD, Ply, read_ply, rotated, write_ply
from slam.formats.trajectory import Trajectory, nearest_stamps, read_trajectory
from slam.frames import Intrinsics, Sequence
from slam.geometry import se3
from slam.geometry.se3 import FloatArray
from slam.loops.places import Places, PlaceStructure
from slam.loops.verification import OF_KEYFRAMES
from slam.mapping.submap import moved_rows
from slam.results.folder import RunFolder, check_replaced
from slam.results.metrics import CAMERA_HEIGHTS, METRES
from slam.runtime.errors import RunError, SlamError
from slam.runtime.files import ESTIMATE, MAP_CLOUD, MAP_MESH, PLACES, write_atomically
from slam.sequences.camera_file import is_field_of_view
from slam.sequences.catalogue import open_sequence

logger = logging.getLogger(__name__)

R_UP_WORLDS = {"y-down": np.eye(3), "z": R_UP_WORLD}  # from a camera's x right, y down, z ahead
POINTS, TRANSFORMS = "points.ply", "transforms.json"
_IMAGES = "images"
_MADE_BY = {"made_by": "erfsfm-slam"}
_MAPS = {"mesh": MAP_MESH, "cloud": MAP_CLOUD}
_SUFFIXES = {
    "mesh": (".ply",),
    "cloud": (".ply",),
    "occupancy": (".yaml", ".pgm"),
    "colmap": (),
    "nerfstudio": (),
}
_SCENES = {  # files, and what one of them holds if it is ours
    "colmap": ((_IMAGES, BINARY_FOLDER, *MODEL_FILES), HEADER),
    "nerfstudio": ((_IMAGES, POINTS, TRANSFORMS), json.dumps(_MADE_BY)[1:-1]),
}
_T_CAMERA_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_HALF_PIXEL = 0.5  # (0.5, 0.5) is the centre of their top-left pixel
_TAKERS = {"resolution": ("occupancy",), "dataset": tuple(_SCENES), "points": ("colmap",)}
_RESOLUTION = 0.1  # of an occupancy grid
_SAME_STAMP_S = 2e-3
_SAME_PIXEL = 0.01
_GREY = 128

# of an occupancy grid
FREE, OCCUPIED, UNKNOWN = 254, 0, 205
_THRESHOLDS = {"occupied_thresh": 0.65, "free_thresh": 0.196}
OBSTACLE_FROM_M, OBSTACLE_TO_M = 0.3, 2.5
_USUAL_CAMERA_HEIGHT_M = 1.65
_HOLE_M = 0.5  # gaps of the map in the road, up to this wide, are closed
_MIN_FREE_AREA, _MIN_OCCUPIED_AREA = 0.25, 0.5  # of a cell
_SAMPLES_A_CELL = 4.0
_CHUNK = 250_000  # triangles at a time
_MOST_CELLS = 64_000_000
_BORDER_DECIMALS = 6
_EVENLY = np.array(
    [0.7548776662466927, 0.5698402909980532]
)  # steps of Roberts' R2 sequence, which fills a square

# of its ground, in camera heights
_ANCHOR_STEP = 0.6
_RADIUS = 3.5
_NEAREST, _FURTHEST = 0.4, 2.5  # a road lies so far below the camera
_BAND = 0.3  # around it, surface of the road and kerbs
_REACH = 12.0
_MIN_POINTS = 30
_LEAST_SQUARES_ROUNDS = 6
_TUKEY = 0.12
_TILT_PRIOR = (
    0.05  # weight of the camera's own tilt, against one of a point at the edge of the neighbourhood
)
_NEIGHBOURS = 6


def export(
    folder: RunFolder,
    what: str,
    output: Path,
    up: str = "y-down",
    *,
    resolution: float | None = None,
    dataset: Path | None = None,
    points: int | None = None,
    progress: Progress = silent,
) -> Path:
    """Write one part of a run, each file whole or not at all; missing parent folders are made.

    Args:
        folder: the run.
        what: ``mesh`` or ``cloud`` (PLY), ``colmap`` (a model), ``nerfstudio`` (images and ``transforms.json``) or
            ``occupancy`` (a grid for ROS, always with z up).
        output: the file; for ``colmap`` and ``nerfstudio`` the folder.
        up: ``y-down`` as the run has it; ``z``: x right, y ahead, z up. Cameras keep their own axes, only the world is
            rotated.
        resolution, dataset, points: as ``erfsfm-slam export --help`` explains them.
        progress: is told how many images are written.

    Returns:
        What was written: of an occupancy grid the ``.yaml``.

    Raises:
        SlamError: an option without effect, a part that the run lacks or that is damaged, missing or other images, or a
            file that cannot be written.
    """
    for name, value in {"resolution": resolution, "dataset": dataset, "points": points}.items():
        if value is not None and what not in _TAKERS[name]:
            raise RunError(
                f"--{name} does nothing for {what}: it is for {' and '.join(_TAKERS[name])}"
            )
    _check_target(what, output)
    if what in _MAPS:
        write_ply(output, _map(folder, what, up))
    elif what == "occupancy":
        return _export_occupancy(folder, output, resolution or _RESOLUTION)
    else:
        trajectory = _trajectory(folder, up)
        cloud = _map(folder, "cloud", up) if (folder.path / MAP_CLOUD).is_file() else None
        without = _interpolated(folder)
        has_images = (
            what == "nerfstudio"
            or dataset is not None
            or folder.metrics().provenance.recording is not None
        )
        if has_images:
            camera, written = _write_images(folder, output, trajectory, dataset, progress)
            without = set(range(len(trajectory))) - set(written)
        else:
            logger.warning(
                "%s does not record where its images are: the model has none; give --dataset",
                folder.path,
            )
        if what == "colmap":
            places = Places.read(folder.require(PLACES))
            model = _model_points(places, R_UP_WORLDS[up], cloud, points)
            write_colmap(output, places.intrinsics, trajectory.T_world_camera, *model, without)
        else:
            _write_scene(output, camera, trajectory, written, cloud)
    return output


def _check_target(what: str, output: Path) -> None:
    """Refuse, before anything is computed, what would replace a file of another kind."""
    suffixes = _SUFFIXES[what]
    if not suffixes and output.exists() and not output.is_dir():
        raise RunError(f"{output} is a file: {what} is several files, give the name of a folder")
    if suffixes and output.suffix.lower() not in suffixes:
        raise RunError(
            f"{what} is written as {' or '.join(suffixes)}; got '{output.name}', give a name that ends so"
        )
    if what in _MAPS:
        check_replaced(output, b"ply")
    elif what == "occupancy":
        refuse_foreign(
            [output.with_suffix(suffix) for suffix in suffixes], "occupied_thresh:", RunError
        )
    else:
        names, mark = _SCENES[what]
        refuse_foreign([output / name for name in names], mark, RunError)


def _export_occupancy(folder: RunFolder, output: Path, resolution: float) -> Path:
    unit = folder.metrics().unit
    if unit not in (METRES, CAMERA_HEIGHTS):
        raise RunError(
            f"heights above the road need metres or camera heights, but this run's lengths are in {unit}"
        )
    mesh, trajectory = _map(folder, "mesh", "z"), _trajectory(folder, "z")
    cells, corner = occupancy_grid(mesh, trajectory.T_world_camera, resolution, unit == METRES)
    written = output.with_suffix(".yaml")
    write_ros_map(written, cells, corner, resolution, unit)
    return written


def _map(folder: RunFolder, what: str, up: str) -> Ply:
    """The mesh or cloud of the map in the given axes."""
    ply = read_ply(folder.require(_MAPS[what]))
    if len(ply.vertices) == 0 or (ply.triangles is not None and len(ply.triangles) == 0):
        raise RunError("the map is empty: there is nothing to export")
    return ply if up == "y-down" else rotated(ply, R_UP_WORLDS[up])


def _trajectory(folder: RunFolder, up: str) -> Trajectory:
    """The optimised trajectory in the given axes."""
    trajectory = read_trajectory(folder.require(ESTIMATE), "tum")
    frames = folder.metrics().sequence.frames
    if frames is not None and frames != len(trajectory):
        raise RunError(
            f"{folder.path}: {ESTIMATE} is damaged: it has {len(trajectory)} rows for {frames} frames"
        )
    return replace(
        trajectory,
        T_world_camera=se3.make(R_UP_WORLDS[up], np.zeros(3)) @ trajectory.T_world_camera,
    )


def _model_points(
    places: Places, R_up_world: FloatArray, cloud: Ply | None, at_most: int | None
) -> tuple[FloatArray, NDArray[np.uint8], Sightings]:
    """Points ``(P, 3)`` of a model and their colours: corners tracked through the images, then the cloud of the map.

    Of more than ``at_most`` those with the longest tracks are taken.
    """
    points, sightings = np.zeros((0, 3)), Sightings.none()
    if places.views:
        structure = PlaceStructure(places, OF_KEYFRAMES)
        tracks = structure.tracks()
        length = np.bincount(tracks.point, minlength=len(tracks.points))
        is_known = np.isfinite(tracks.points).all(axis=1)
        chosen = np.argsort(np.where(is_known, -length, 1), kind="stable")[: int(is_known.sum())][
            :at_most
        ]
        number = np.full(len(tracks.points), -1)
        number[chosen] = np.arange(len(chosen))
        kept = number[tracks.point] >= 0
        views, corners = tracks.views[kept], tracks.corners[kept]
        frames = np.array([view.index for view in places.views], np.intp)[views]
        pixels, errors_px = structure.pixels(views, corners), tracks.errors_px[kept]
        points = tracks.points[chosen] @ R_up_world.T
        sightings = Sightings(frames, pixels, number[tracks.point[kept]], errors_px)
    colours = np.full((len(points), 3), _GREY, np.uint8)
    if cloud is not None:
        if len(points):
            colours = cloud.colours[cKDTree(cloud.points).query(points)[1]]
        count = (
            len(cloud.points)
            if at_most is None
            else min(max(at_most - len(points), 0), len(cloud.points))
        )
        rows = np.linspace(0, len(cloud.points) - 1, count).round().astype(np.intp)
        points = np.concatenate([points, cloud.points[rows]])
        colours = np.concatenate([colours, cloud.colours[rows]])
    return points, colours, sightings


def _write_scene(
    output: Path, camera: Intrinsics, trajectory: Trajectory, frames: list[int], cloud: Ply | None
) -> None:
    """Write ``points.ply`` and, last, ``transforms.json``, which tools for Gaussian splatting read.

    Its cameras have OpenGL's axes: x right, y up, z backwards.
    """
    scene: dict[str, Any] = {
        **_MADE_BY,
        "camera_model": "OPENCV",
        "fl_x": float(camera.fx),
        "fl_y": float(camera.fy),
        "cx": float(camera.cx) + _HALF_PIXEL,
        "cy": float(camera.cy) + _HALF_PIXEL,
        "w": camera.width,
        "h": camera.height,
        **dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0),
    }
    if cloud is not None:
        write_ply(output / POINTS, cloud)
        scene["ply_file_path"] = POINTS
    poses = {k: (trajectory.T_world_camera[k] @ _T_CAMERA_OPENGL).tolist() for k in frames}
    scene["frames"] = [
        {"file_path": _image_name(k), "transform_matrix": pose} for k, pose in poses.items()
    ]
    text = json.dumps(scene, indent=2, allow_nan=False) + "\n"
    write_atomically(output / TRANSFORMS, text, RunError)


def _write_images(
    folder: RunFolder,
    output: Path,
    trajectory: Trajectory,
    dataset: Path | None,
    progress: Progress,
) -> tuple[Intrinsics, list[int]]:
    """Write ``images/NNNNNN.png`` of all frames with a usable image; they are returned, with their camera."""
    sequence, rows = _recording(folder, trajectory, dataset)
    written, without = [], _interpolated(folder)
    for k, row in enumerate(rows):
        progress("images", k + 1, len(rows))
        if row is None or k in without:
            continue
        try:
            image = sequence.frame(row).image
        except (SlamError, ErfsfmError):
            continue
        content = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1].tobytes()
        write_atomically(output / _image_name(k), content, RunError)
        written.append(k)
    if not written:
        raise RunError(f"no image of {folder.path} can be read: check the data set")
    if len(written) < len(rows):
        logger.warning(
            "%d of %d frames have no usable image: left out", len(rows) - len(written), len(rows)
        )
    return sequence.intrinsics, written


def _image_name(frame: int) -> str:
    """Of the image of a frame, seen from the scene's folder."""
    return f"{_IMAGES}/{frame:06d}.png"


def _recording(
    folder: RunFolder, trajectory: Trajectory, dataset: Path | None
) -> tuple[Sequence, list[int | None]]:
    """The recording of a run, and which frame of it, by its stamp, each row of the trajectory is."""
    recorded = folder.metrics().provenance.recording
    if recorded is None and dataset is None:
        raise RunError(f"{folder.path} does not record where its images are: give --dataset ROOT")
    recorded = recorded or {}
    place, camera = (
        Path(recorded[name]) if name in recorded else None for name in ("dataset", "camera")
    )
    if (
        dataset is not None
        and camera is not None
        and not (camera.exists() or is_field_of_view(camera))
    ):
        camera = None  # it may have moved with the images
    try:
        sequence = open_sequence(dataset or place, recorded.get("sequence"), camera)
    except (SlamError, ErfsfmError) as error:
        raise RunError(
            f"the images of {folder.path} are needed and not found ({error}); give --dataset ROOT"
        ) from error
    own = Places.read(folder.require(PLACES)).intrinsics
    expected, found = (
        (c.width, c.height, c.fx, c.fy, c.cx, c.cy) for c in (own, sequence.intrinsics)
    )
    if not np.allclose(expected, found, atol=_SAME_PIXEL):
        raise RunError(
            f"{sequence.name} has another camera than {folder.path}: give the data set of the run"
        )
    stamps = np.asarray(sequence.stamps)
    nearest = nearest_stamps(trajectory.stamps, stamps)
    same = np.abs(stamps[nearest] - trajectory.stamps) < _SAME_STAMP_S
    if not same.any():
        raise RunError(
            f"{sequence.name} has no frame at the times of {folder.path}: give the data set of the run"
        )
    return sequence, [
        row if is_same else None for row, is_same in zip(nearest.tolist(), same, strict=True)
    ]


def _interpolated(folder: RunFolder) -> set[int]:
    """Frames of a run without a usable image."""
    return {
        k for gap in folder.metrics().sequence.bridged or () for k in range(gap.first, gap.last + 1)
    }


@dataclass(frozen=True)
class Ground:
    """Planes ``z = z0 + slope (x - x0)`` under ``anchors`` ``(A, 3)``, with ``slopes`` ``(A, 2)``; z is up."""

    anchors: FloatArray
    slopes: FloatArray
    reach: float

    def heights(self, places: FloatArray) -> FloatArray:
        """Height of the ground ``(P,)`` under places ``(P, 2)``; NaN far from the drive."""
        count = min(_NEIGHBOURS, len(self.anchors))
        distances, nearest = cKDTree(self.anchors[:, :2]).query(places, k=count)
        distances, nearest = (
            distances.reshape(len(places), count),
            nearest.reshape(len(places), count),
        )
        offsets = places[:, None] - self.anchors[nearest, :2]
        planes = self.anchors[nearest, 2] + (self.slopes[nearest] * offsets).sum(axis=2)
        # neighbours count by their distance beyond the nearest, so that planes go over into each other
        weights = 1.0 / (distances - distances[:, :1] + 0.05 * self.reach / _REACH)
        blended = (planes * weights).sum(axis=1) / weights.sum(axis=1)
        return np.where(distances[:, 0] <= self.reach, blended, np.nan)


@dataclass(frozen=True)
class Grid:
    """Square cells of the x-y plane, row by row from the smallest y; ``first`` ``(2,)`` counts from the origin."""

    first: FloatArray
    width: int
    height: int
    resolution: float

    @classmethod
    def around(cls, points: FloatArray, resolution: float) -> Grid:
        """The cells that points ``(P, 3)`` lie in; their borders are multiples of ``resolution``."""
        # rounded, so that an edge on a border of cells does not begin another row
        low = np.floor((points[:, :2].min(axis=0) / resolution).round(_BORDER_DECIMALS))
        high = np.ceil((points[:, :2].max(axis=0) / resolution).round(_BORDER_DECIMALS))
        width, height = (int(size) for size in np.maximum(high - low, 1.0))
        if width * height > _MOST_CELLS:
            raise RunError(
                f"--resolution {resolution:g} gives {width} x {height} cells, more than {_MOST_CELLS:,}: "
                "give a larger one"
            )
        return cls(low, width, height, resolution)

    @property
    def corner(self) -> FloatArray:
        """Smallest x and y ``(2,)``."""
        return (self.first * self.resolution).round(9)

    def cells(self, points: FloatArray) -> NDArray[np.int64]:
        """Flat numbers ``(P,)`` of the cells of points ``(P, 2 or 3)``."""
        places = np.floor(points[:, :2] / self.resolution - self.first)
        column, row = np.clip(places, 0, [self.width - 1, self.height - 1]).astype(np.int64).T
        return np.asarray(row * self.width + column)

    def centres(self, cells: NDArray[np.int64]) -> FloatArray:
        """Centres ``(C, 2)`` of cells by their flat numbers."""
        row, column = np.divmod(cells, self.width)
        return np.asarray(
            (self.first + 0.5 + np.stack([column, row], axis=1)) * self.resolution, np.float64
        )


def occupancy_grid(
    mesh: Ply, T_world_camera: FloatArray, resolution: float, is_metric: bool
) -> tuple[NDArray[np.uint8], FloatArray]:
    """Sort the surface of each cell by its height above the local ground.

    Args:
        mesh: x right, y ahead, z up.
        T_world_camera: poses of the drive ``(N, 4, 4)`` in the same axes.
        resolution: side of a cell.
        is_metric: whether lengths are metres; else they are camera heights.

    Returns:
        ``FREE``, ``OCCUPIED`` or ``UNKNOWN`` of each cell ``(H, W)``, largest y first, and x and y of the outer corner
        at the bottom left ``(2,)``.
    """
    metre = 1.0 if is_metric else 1.0 / _USUAL_CAMERA_HEIGHT_M
    ground = ground_along(mesh.points, T_world_camera, _USUAL_CAMERA_HEIGHT_M * metre)
    grid = Grid.around(mesh.points, resolution)
    shape = (grid.height, grid.width)
    free, occupied = np.zeros(shape).ravel(), np.zeros(shape).ravel()
    for points, areas in samples(mesh, resolution):
        cells = grid.cells(points)
        touched, which = np.unique(cells, return_inverse=True)
        above = points[:, 2] - ground.heights(grid.centres(touched))[which]
        on_ground = np.abs(above) < OBSTACLE_FROM_M * metre
        standing = (above >= OBSTACLE_FROM_M * metre) & (above <= OBSTACLE_TO_M * metre)
        for total, chosen in ((free, on_ground), (occupied, standing)):
            total += np.bincount(cells[chosen], areas[chosen], len(total))
    is_free = (free >= _MIN_FREE_AREA * resolution**2).reshape(shape).astype(np.uint8)
    hole = max(int(_HOLE_M * metre / resolution), 1)
    element = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (hole, hole))
    values = np.full(shape, UNKNOWN, np.uint8)
    values[cv2.morphologyEx(is_free, cv2.MORPH_CLOSE, element) > 0] = FREE
    values[(occupied >= _MIN_OCCUPIED_AREA * resolution**2).reshape(shape)] = OCCUPIED
    return np.ascontiguousarray(values[::-1]), grid.corner


def samples(mesh: Ply, resolution: float) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Points ``(S, 3)`` spread evenly over each triangle, several in the area of a cell, and their areas ``(S,)``."""
    assert mesh.triangles is not None
    vertices = mesh.points
    for start in range(0, len(mesh.triangles), _CHUNK):
        corners = vertices[mesh.triangles[start : start + _CHUNK]]
        edges = corners[:, 1:] - corners[:, :1]
        areas = 0.5 * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
        counts = np.ceil(_SAMPLES_A_CELL * areas / resolution**2).astype(np.int64)
        for part in np.array_split(
            np.arange(len(counts)), max(int(counts.sum()) // (4 * _CHUNK), 1)
        ):
            rows = np.repeat(part, counts[part])
            within = np.arange(len(rows)) - np.repeat(
                np.cumsum(counts[part]) - counts[part], counts[part]
            )
            uv = (0.5 + within[:, None] * _EVENLY) % 1.0
            uv = np.where(
                uv.sum(axis=1, keepdims=True) > 1.0, 1.0 - uv, uv
            )  # the other half of the square
            yield (
                corners[rows, 0] + (uv[:, :, None] * edges[rows]).sum(axis=1),
                areas[rows] / counts[rows],
            )


def ground_along(points: FloatArray, T_world_camera: FloatArray, camera_height: float) -> Ground:
    """The ground by points of the map ``(P, 3)``, z up, under cameras ``(N, 4, 4)`` in the same axes.

    ``camera_height`` is a first guess, which the map then corrects.
    """
    chosen = moved_rows(T_world_camera, _ANCHOR_STEP * camera_height, math.inf)
    cameras, up = T_world_camera[chosen, :3, 3], -T_world_camera[chosen, :3, 1]
    tree = cKDTree(points[:, :2])

    def around() -> Iterator[
        tuple[FloatArray, FloatArray]
    ]:  # twice: all at once take 0.7 GB a kilometre
        for camera, axis in zip(cameras, up, strict=True):
            near = points[tree.query_ball_point(camera[:2], _RADIUS * camera_height)]
            yield near, -((near - camera) @ axis)

    limits = _NEAREST * camera_height, _FURTHEST * camera_height
    found = (depth[(depth > limits[0]) & (depth < limits[1])] for _, depth in around())
    medians = [float(np.median(depth)) for depth in found if len(depth) >= _MIN_POINTS]
    if not medians:
        raise RunError(
            "the map has no ground below the cameras, so free and occupied cannot be told apart"
        )
    height = float(np.median(medians))
    planes = [
        _plane(
            near[np.abs(depth - height) < _BAND * height],
            camera - height * axis,
            -axis[:2] / axis[2],
            height,
        )
        for (near, depth), camera, axis in zip(around(), cameras, up, strict=True)
    ]
    anchors, slopes = map(np.array, zip(*planes))
    return Ground(anchors, slopes, _REACH * height)


def write_ros_map(
    path: Path, cells: NDArray[np.uint8], corner: FloatArray, resolution: float, unit: str
) -> None:
    """Write a grid as `occupancy_grid` gives it: ``<name>.pgm`` and, after it, ``<name>.yaml``, each atomically.

    ``map_server`` takes lengths for metres, whatever their ``unit`` is: a comment says so.
    """
    image = path.with_suffix(".pgm")
    write_atomically(image, cv2.imencode(".pgm", cells)[1].tobytes(), RunError)
    description = {
        "image": image.name,
        "resolution": resolution,
        "origin": [*corner.tolist(), 0.0],
        "negate": 0,
    }
    text = yaml.safe_dump(description | _THRESHOLDS, sort_keys=False, default_flow_style=None)
    write_atomically(path, f"# lengths in {unit}\n{text}", RunError)


def _plane(
    points: FloatArray, start: FloatArray, tilt: FloatArray, height: float
) -> tuple[FloatArray, FloatArray]:
    """A robust plane through points, near the one through ``start`` with slope ``tilt``: its point and slope."""
    if len(points) < _MIN_POINTS:
        return start, tilt
    offsets = points[:, :2] - start[:2]
    residual_of = points[:, 2] - start[2] - offsets @ tilt
    design = np.column_stack([np.ones(len(points)), offsets / (_RADIUS * height)])
    prior = np.diag([0.0, 1.0, 1.0]) * _TILT_PRIOR * len(points)
    change = np.array([np.median(residual_of), 0.0, 0.0])
    for _ in range(_LEAST_SQUARES_ROUNDS):
        ratio = (residual_of - design @ change) / (_TUKEY * height)
        weights = np.clip(1 - ratio**2, 0, None) ** 2
        if weights.sum() < _MIN_POINTS / 2:
            return start, tilt
        weighted = design * weights[:, None]
        change = np.linalg.solve(weighted.T @ design + prior, weighted.T @ residual_of)
    return start + np.array([0.0, 0.0, change[0]]), tilt + change[1:] / (_RADIUS * height)
