"""An embedded street world: images, exact depth, exact poses and LiDAR scans of a simulated drive.

Surfaces are ray-cast with Open3D; everything else is NumPy (``slam/simulation``).
"""

import functools
import json
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, cast, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from slam.geometry import se3
from slam.runtime.errors import SequenceError
from slam.runtime.imports import import_open3d
from slam.simulation import hazards as effects
from slam.simulation.geometry import Float32Array, FloatArray
from slam.simulation.hazards import Hazard, Traffic
from slam.simulation.kitti_layout import (
    write_calibration,
    write_depth,
    write_image,
    write_lines,
    write_poses,
)
from slam.simulation.lidar import T_CAMERA_LIDAR, beam_directions, measured
from slam.simulation.light import draw_weather, sky
from slam.simulation.optics import draw_mount, kitti_intrinsics, pixel_rays
from slam.simulation.painter import Hits, facing_normals, paint
from slam.simulation.route import RouteKind, plan_route
from slam.simulation.surface import Surface, place_rays
from slam.simulation.town import build_town

VERSION = 1  # of the world: the same options give the same bytes within a version
FPS = 10.0
MOST_FRAMES = 100_000
_MOST_PIXELS = 2**25
FARTHEST_M = 200.0  # surfaces beyond are treated as sky


@dataclass(frozen=True)
class SimulationOptions:
    """The street to simulate; ``seed`` determines everything else.

    A ``varied`` one has another camera than KITTI's, railings and people, and cars that overtake if any move.
    """

    route: RouteKind = "loop"
    frames: int = 300
    seed: int = 0
    width: int = 416
    height: int = 128
    hazards: tuple[Hazard, ...] = ()
    varied: bool = False

    def __post_init__(self) -> None:
        """Refuse invalid options.

        Raises:
            SequenceError: naming the option.
        """
        if self.route not in get_args(RouteKind):
            raise SequenceError(f"route must be one of {', '.join(get_args(RouteKind))}; got {self.route!r}")
        for hazard in self.hazards:
            if hazard not in get_args(Hazard):
                raise SequenceError(f"hazards are {', '.join(get_args(Hazard))}; got {hazard!r}")
        if self.seed < 0:
            raise SequenceError(f"seed must be 0 or more; got {self.seed}")
        if self.frames > MOST_FRAMES:
            raise SequenceError(f"a drive has {MOST_FRAMES:,} frames at most; got {self.frames:,}")
        if min(self.width, self.height) < 8 or self.width * self.height > _MOST_PIXELS:
            raise SequenceError(
                f"images must be 8 x 8 or larger, of {_MOST_PIXELS:,} pixels at most; got {self.width} x {self.height}"
            )


def parse_options(
    route: str, frames: int, seed: int, width: int, height: int, hazards: str, varied: bool = False
) -> SimulationOptions:
    """Options from a command line; ``hazards`` is a comma list.

    Raises:
        SequenceError: if one of them is invalid.
    """
    names = tuple(name.strip() for name in hazards.split(",") if name.strip())
    kinds = cast(tuple[Hazard, ...], names)
    return SimulationOptions(cast(RouteKind, route), frames, seed, width, height, kinds, varied)


@dataclass(frozen=True)
class SimulatedFrame:
    """One frame with its truth.

    Attributes:
        index: number of the frame.
        stamp: seconds.
        image: ``(H, W, 3)`` uint8 RGB.
        depth: z-depth in metres, 0 where nothing was hit, ``(H, W)`` float32.
        T_world_camera: pose in the frame of the first camera, ``(4, 4)``.
    """

    index: int
    stamp: float
    image: NDArray[np.uint8]
    depth: Float32Array
    T_world_camera: FloatArray


class SimulatedStreet:
    """A street world and a drive through it; frames are rendered on demand.

    Attributes:
        options: what is simulated.
        K: camera matrix, ``(3, 3)``.
        camera_height_m: of the camera above the road.
        T_camera_lidar: ``(4, 4)``.
        T_world_camera: every pose in the frame of the first camera, ``(N, 4, 4)``.
    """

    def __init__(self, options: SimulationOptions) -> None:
        """Plan the drive.

        Raises:
            SequenceError: if there are too few frames for the route.
        """
        self.options = options
        self.K: FloatArray = kitti_intrinsics(options.width, options.height)
        still = effects.STILL_FRAMES if "stop" in options.hazards else 0
        mount = draw_mount(options.seed) if options.varied else None
        if mount is not None:
            self.K[[0, 1], [0, 1]] *= mount.zoom
        self._route = plan_route(options.route, options.frames, options.seed, still, mount)
        self.camera_height_m = self._route.camera_height_m
        self.T_camera_lidar: FloatArray = T_CAMERA_LIDAR.copy()
        self.T_world_camera: FloatArray = se3.invert(self._route.T_street_camera[0]) @ self._route.T_street_camera
        self.T_world_camera[0] = np.eye(4)
        self._weather = draw_weather(options.seed)
        self._exposure = effects.exposure_curve(options.seed, options.frames)
        self._traffic = Traffic(self._route, options.seed, options.varied) if "moving-cars" in options.hazards else None
        self._rays = pixel_rays(self.K, options.width, options.height)
        self._stretch = np.linalg.norm(self._rays, axis=1).astype(np.float32)  # ray length per depth

    def __len__(self) -> int:
        """Number of frames."""
        return self.options.frames

    def render(self, index: int) -> SimulatedFrame:
        """Image and depth of one frame; the same index gives the same bytes."""
        self._require(index)
        surfaces = self._surfaces(index)
        if "blur" in self.options.hazards:
            shutter = effects.shutter_poses(self._route.T_street_camera, index)
            rgb = np.mean([self._view(surfaces, T_street_camera)[0] for T_street_camera in shutter], axis=0)
            _, depth = self._view(surfaces, self._route.T_street_camera[index])
        else:
            rgb, depth = self._view(surfaces, self._route.T_street_camera[index])
        image = self._develop(rgb, index)
        return SimulatedFrame(index, index / FPS, image, depth, self.T_world_camera[index].copy())

    def depth(self, index: int) -> Float32Array:
        """The z-depth ``(H, W)`` of `render`, without the image."""
        self._require(index)
        rays = place_rays(self._route.T_street_camera[index], self._rays)
        depth: Float32Array = np.min([surface.cast(rays)["t_hit"] for surface in self._surfaces(index)], axis=0)
        depth[depth >= FARTHEST_M] = 0.0
        return depth.reshape(self.options.height, self.options.width)

    def scan(self, index: int) -> Float32Array:
        """LiDAR points of one frame: x, y, z in the LiDAR frame, metres, and reflectance, ``(M, 4)``."""
        self._require(index)
        rng = np.random.default_rng([self.options.seed, 40, index])
        directions = beam_directions(rng)
        T_street_lidar = self._route.T_street_camera[index] @ self.T_camera_lidar
        rays = place_rays(T_street_lidar, directions)
        ranges = np.full(len(rays), np.inf, dtype=np.float32)
        reflectance = np.zeros(len(rays), dtype=np.float32)
        for surface in self._surfaces(index):
            answer = surface.cast(rays)
            nearer = np.flatnonzero(answer["t_hit"] < ranges)
            ranges[nearer] = answer["t_hit"][nearer]
            instance = surface.mesh.instance[answer["primitive_ids"][nearer]]
            reflectance[nearer] = surface.mesh.colours[0][:, instance].mean(axis=0)
        return measured(directions, ranges, reflectance, rng)

    def distance_to_surface(self, points_world: NDArray[np.floating[Any]]) -> FloatArray:
        """Distance in metres from points ``(M, 3)`` to the nearest static surface, ``(M,)``."""
        points = se3.apply(self._route.T_street_camera[0], np.asarray(points_world, dtype=np.float64))
        tensor = import_open3d().core.Tensor(points.astype(np.float32))
        return np.asarray(self._still.scene.compute_distance(tensor).numpy(), dtype=np.float64)

    @functools.cached_property
    def _still(self) -> Surface:
        return Surface.of(build_town(self._route.plan, self._route.bend, self.options.seed, self.options.varied))

    def _surfaces(self, index: int) -> list[Surface]:
        """The surfaces at a frame: the static town and the moving cars."""
        cars = self._traffic.placed(index) if self._traffic else None
        return [self._still] if cars is None else [self._still, Surface.of(cars)]

    def _view(self, surfaces: list[Surface], T_street_camera: FloatArray) -> tuple[Float32Array, Float32Array]:
        """Colour ``(H, W, 3)``, about [0, 1], and z-depth ``(H, W)`` from a pose."""
        rays = place_rays(T_street_camera, self._rays)  # z = 1, so that t is z-depth
        unit = np.ascontiguousarray(rays[:, 3:].T) / self._stretch  # (3, H * W)
        answers = [surface.cast(rays) for surface in surfaces]
        depths = np.stack([answer["t_hit"] for answer in answers])
        nearest, depth = np.argmin(depths, axis=0), depths.min(axis=0)
        depth[depth >= FARTHEST_M] = 0.0
        rgb = np.empty((len(rays), 3), dtype=np.float32)
        unseen = np.flatnonzero(depth == 0.0)
        rgb[unseen] = sky(self._weather, unit[:, unseen]).T
        for number, (surface, answer) in enumerate(zip(surfaces, answers)):
            seen = np.flatnonzero((nearest == number) & (depth > 0.0))
            triangle = answer["primitive_ids"][seen].astype(np.int64)
            order = np.argsort(np.take(surface.mesh.material, triangle), kind="stable")
            seen, triangle = seen[order], triangle[order]
            hits = Hits(
                triangle=triangle,
                barycentric=np.take(answer["primitive_uvs"], seen, axis=0).T,
                rays=np.take(unit, seen, axis=1),
                normals=facing_normals(surface.mesh, triangle, np.take(unit, seen, axis=1)),
                depth=depth[seen],
                distance=depth[seen] * self._stretch[seen],
            )
            lit = self._sunlit(surfaces, np.take(rays, seen, axis=0), hits, seen)
            rgb[seen] = paint(surface.mesh, hits, lit, self._weather, float(self.K[0, 0])).T
        shape = self.options.height, self.options.width
        return rgb.reshape(*shape, 3), depth.reshape(shape)

    def _sunlit(
        self, surfaces: list[Surface], rays: Float32Array, hits: Hits, pixels: NDArray[np.int64]
    ) -> Float32Array:
        """Visibility of the sun from each hit, smoothed over neighbouring pixels, ``(N,)``."""
        towards = np.flatnonzero(self._weather.sun @ hits.normals > 0.0)
        to_sun = np.take(rays, towards, axis=0)
        to_sun[:, :3] += to_sun[:, 3:] * hits.depth[towards, None] + 0.03 * hits.normals[:, towards].T
        to_sun[:, 3:] = self._weather.sun
        tensor = import_open3d().core.Tensor(to_sun)
        shadow = np.any([surface.scene.test_occlusions(tensor).numpy() for surface in surfaces], axis=0)
        lit = np.ones(self.options.height * self.options.width, dtype=np.float32)
        lit[pixels[towards]] = 1.0 - shadow
        soft = cv2.blur(lit.reshape(self.options.height, self.options.width), (3, 3))
        return np.asarray(np.take(soft, pixels), dtype=np.float32)

    def _develop(self, rgb: Float32Array, index: int) -> NDArray[np.uint8]:
        """Rain, lens blur, exposure, and quantisation to 8 bits."""
        rgb = rgb * np.float32(self._weather.exposure)
        if "rain" in self.options.hazards:
            rgb = effects.rained_on(rgb, self.options.seed, index)
        rgb = cv2.GaussianBlur(rgb, (3, 3), 0.55)
        if "exposure" in self.options.hazards:
            rgb = effects.exposed(rgb, float(self._exposure[index, 0]), float(self._exposure[index, 1]))
        return np.asarray(np.clip(rgb * np.float32(255.0) + np.float32(0.5), 0.0, 255.0)).astype(np.uint8)

    def _require(self, index: int) -> None:
        if not 0 <= index < len(self):
            raise IndexError(f"the simulated drive has frames 0 to {len(self) - 1}; asked for {index}")


def write_kitti_root(
    street: SimulatedStreet,
    output: Path,
    depth: bool = False,
    lidar: bool = False,
    progress: Callable[[int], None] | None = None,
) -> None:
    """Write a drive as the KITTI odometry root ``output`` with the one sequence ``sim``.

    Args:
        street: the drive.
        output: a folder that does not exist yet or is empty.
        depth: whether to write depth maps (16 bit, metres x 256, 0 where nothing was hit).
        lidar: whether to write scans.
        progress: called with the number of frames written so far.

    Raises:
        SequenceError: if ``output`` holds something already, or cannot be written.
    """
    if output.exists() and (not output.is_dir() or any(output.iterdir())):
        raise SequenceError(f"{output} is {'not empty' if output.is_dir() else 'a file'}; remove it or choose another")
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        partial = Path(tempfile.mkdtemp(prefix=f".{output.name}.", dir=output.parent))
        partial.chmod(0o755)
        try:
            _write_frames(street, partial / "sequences" / "sim", depth, lidar, progress)
            _write_records(street, partial)
            partial.replace(output)
        finally:
            shutil.rmtree(partial, ignore_errors=True)
    except OSError as error:
        raise SequenceError(f"cannot write the simulated sequence to {output}: {error}") from error


def _write_frames(
    street: SimulatedStreet,
    folder: Path,
    depth: bool,
    lidar: bool,
    progress: Callable[[int], None] | None,
) -> None:
    """Images, and depth maps and scans if wanted."""
    wanted = {"image_2": True, "depth_2": depth, "velodyne": lidar}
    for name in (name for name, is_wanted in wanted.items() if is_wanted):
        (folder / name).mkdir(parents=True)
    for index in range(len(street)):
        frame = street.render(index)
        write_image(folder / "image_2" / f"{index:06d}.png", frame.image)
        if depth:
            write_depth(folder / "depth_2" / f"{index:06d}.png", frame.depth)
        if lidar:
            street.scan(index).astype("<f4").tofile(folder / "velodyne" / f"{index:06d}.bin")
        if progress:
            progress(index + 1)


def _write_records(street: SimulatedStreet, root: Path) -> None:
    """Calibration, times, poses, the camera and what was simulated."""
    sequence, K, options = root / "sequences" / "sim", street.K, street.options
    write_calibration(sequence / "calib.txt", K, street.T_camera_lidar)
    write_lines(sequence / "times.txt", [f"{index / FPS:.6e}" for index in range(len(street))])
    (root / "poses").mkdir()
    write_poses(root / "poses" / "sim.txt", street.T_world_camera)
    camera = {"width": options.width, "height": options.height, "fx": K[0, 0], "fy": K[1, 1]}
    camera |= {"cx": K[0, 2], "cy": K[1, 2], "fps": FPS, "camera_height_m": street.camera_height_m}
    write_lines(root / "camera.yaml", [f"{key}: {value}" for key, value in camera.items()] + ["model: pinhole"])
    write_lines(root / "simulation.json", [json.dumps({**asdict(options), "version": VERSION}, indent=2)])
