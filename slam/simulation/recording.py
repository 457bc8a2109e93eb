"""Simulated worlds as recordings: rendered in memory, or written as a KITTI odometry root."""

import json
import shutil
import tempfile
from dataclasses import asdict
from functools import lru_cache, partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from erfsfm.common.progress import Progress, silent
from erfsfm.common.readers.camera_file import CameraFile, Pinhole
from slam.formats.ply import write_ply
from slam.formats.trajectory import Trajectory, write_kitti
from slam.geometry.se3 import FloatArray
from slam.runtime.errors import SequenceError
from slam.sequences.camera_file import write_camera
from slam.sequences.catalogue import open_sequence
from slam.sequences.images import ReadImages
from slam.sequences.recording import RecordedSequence, Source, frame_range, uniform_stamps
from slam.simulation.options import VERSION, SimulationOptions
from slam.simulation.rooms import SimulatedRooms
from slam.simulation.street import SimulatedStreet
from slam.simulation.world import SimulatedWorld

EMBEDDED = SimulationOptions(route="loop", frames=320, seed=640)  # no weights saw it
_CACHED_FRAMES = 320  # of the embedded world 50 MB; the look ahead and the run read each frame


def simulated_world(options: SimulationOptions) -> SimulatedWorld:
    """The street or the rooms of these options.

    Raises:
        SequenceError: if there are too few frames for the route.
    """
    return SimulatedRooms(options) if options.route == "rooms" else SimulatedStreet(options)


class SimulatedSequence(RecordedSequence):
    """A ``SimulatedWorld`` as a sequence; ``street`` has the depth, the scans and the true surface.

    ``reference`` is re-based to the first camera; ``street.T_world_camera[0]`` takes it to the street.
    """

    is_rendered = True

    def __init__(self, options: SimulationOptions) -> None:
        street = self.street = simulated_world(options)
        rendered = lru_cache(maxsize=_CACHED_FRAMES)(street.render)
        super().__init__(
            "sim",
            ReadImages(
                options.width,
                options.height,
                options.frames,
                lambda index: np.array(rendered(index)),
            ),
            street.camera,
            uniform_stamps(options.frames, options.rate),
            (Source(f"simulated/{options.seed}", first=None),),
            T_any_camera=street.T_world_camera,
            usual_height_m=street.camera_height_m,
            T_camera_lidar=street.T_camera_lidar,
            depth_maps={k: partial(street.depth, k) for k in range(options.frames)},
            distance_to_surface=street.distance_to_surface,
        )


def open_or_embedded(
    dataset: Path | None = None,
    name: str | None = None,
    camera: Path | None = None,
    frames: str | None = None,
    truth: Path | None = None,
) -> RecordedSequence:
    """Open a sequence as `open_sequence`; the embedded world where neither a data set nor a name is given.

    Raises:
        SequenceError: one line on what was searched, where, what was found and what to do.
    """
    if dataset is not None or name is not None:
        return open_sequence(dataset, name, camera, frames, truth)
    if camera is not None or truth is not None:
        raise SequenceError("a camera or true poses without a data set: give --dataset as well")
    world = SimulatedSequence(EMBEDDED)
    return world if frames is None else world.cut(*frame_range(frames, len(world)))


def write_kitti_root(
    world: SimulatedWorld,
    output: Path,
    depth: bool = False,
    lidar: bool = False,
    progress: Progress = silent,
    mesh: bool = False,
) -> None:
    """Write a drive as the KITTI odometry root ``output`` with the one sequence ``sim``.

    Args:
        world: the drive.
        output: a folder that does not exist yet or is empty.
        depth: whether to write depth maps (16 bit, metres x 256, 0 where nothing was hit).
        lidar: whether to write scans.
        progress: is told how many frames are written.
        mesh: whether to write all surfaces that stand still, as ``mesh.ply`` in the frame of the
            first camera.

    Raises:
        SequenceError: if ``output`` holds something already, or cannot be written; scans of a
            world without a LiDAR.
    """
    if lidar and world.T_camera_lidar is None:
        raise SequenceError(f"no LiDAR is carried through {world.options.route}: leave --lidar out")
    if output.exists() and (not output.is_dir() or any(output.iterdir())):
        raise SequenceError(
            f"{output} is {'not empty' if output.is_dir() else 'a file'};"
            " remove it or choose another"
        )
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        partial = Path(tempfile.mkdtemp(prefix=f".{output.name}.", dir=output.parent))
        partial.chmod(0o755)
        try:
            _write_frames(world, partial / "sequences" / "sim", depth, lidar, progress)
            _write_records(world, partial)
            if mesh:
                write_ply(partial / "mesh.ply", world.mesh_world())
            partial.replace(output)
        finally:
            shutil.rmtree(partial, ignore_errors=True)
    except OSError as error:
        raise SequenceError(
            f"cannot write the simulated sequence to {output}: {error.strerror or error}"
        ) from error


def _write_frames(
    world: SimulatedWorld, folder: Path, depth: bool, lidar: bool, progress: Progress
) -> None:
    """Images, and depth maps and scans if wanted."""
    for name in ["image_2"] + ["depth_2"] * depth + ["velodyne"] * lidar:
        (folder / name).mkdir(parents=True)
    for index in range(len(world)):
        write_image(folder / "image_2" / f"{index:06d}.png", world.render(index))
        if depth:
            units = np.clip(np.rint(world.depth(index) * 256.0), 0.0, 65535.0)
            _write_png(folder / "depth_2" / f"{index:06d}.png", units.astype(np.uint16))
        if lidar:
            world.scan(index).astype("<f4").tofile(folder / "velodyne" / f"{index:06d}.bin")
        progress("frames", index + 1, len(world))


def _write_records(world: SimulatedWorld, root: Path) -> None:
    """Calibration, times, poses, the camera and what was simulated."""
    sequence, camera, options = root / "sequences" / "sim", world.camera, world.options
    # the one camera stands for all four
    projection = _row(np.column_stack([camera.K, np.zeros(3)]))
    rows = [f"P{number}: {projection}" for number in range(4)]
    if world.T_camera_lidar is not None:
        rows.append(f"Tr: {_row(world.T_camera_lidar[:3])}")
    write_lines(sequence / "calib.txt", rows)
    write_lines(
        sequence / "times.txt", [f"{index / options.rate:.6e}" for index in range(len(world))]
    )
    (root / "poses").mkdir()
    stamps = np.arange(len(world), dtype=np.float64)
    write_kitti(root / "poses" / "sim.txt", Trajectory(stamps, world.T_world_camera))
    lens = CameraFile(
        **vars(Pinhole.of(camera)),
        fps=options.rate,
        camera_height_m=world.camera_height_m,
        readout_ms=1e3 * options.readout_s,
    )
    write_camera(root, lens, None)
    record = {**asdict(options), "version": VERSION}
    write_lines(root / "simulation.json", [json.dumps(record, indent=2)])


def write_image(path: Path, image: NDArray[np.uint8]) -> None:
    """An RGB image ``(H, W, 3)`` as PNG."""
    _write_png(path, image[..., ::-1])


def write_lines(path: Path, lines: list[str]) -> None:
    """A text file."""
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _write_png(path: Path, pixels: NDArray[np.uint8] | NDArray[np.uint16]) -> None:
    _, content = cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    path.write_bytes(content.tobytes())  # OpenCV's writer does not say why it fails


def _row(matrix: FloatArray) -> str:
    return " ".join(f"{value:.9e}" for value in matrix.ravel())
