"""Broken recordings of one simulated drive: what the system reports of each, and its error over the clean drive's.

Errors are over the frames that show the road, each segment of the drive aligned on its own (similarity).

Example: python tools/broken_drives.py --fault black --fault wiper
"""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from shared.command import parser_of

from slam import run_slam
from slam.frames import Sequence as FrameSequence
from slam.geometry.se3 import FloatArray, umeyama
from slam.results.metrics import SequenceMetrics
from slam.runtime.errors import SlamError
from slam.runtime.storage.record import Missing, known
from slam.sequences.simulated import SimulatedSequence
from slam.simulation.kitti_layout import write_calibration, write_image, write_lines, write_poses
from slam.simulation.options import STREET_RATE as FPS
from slam.simulation.options import SimulationOptions

Image = NDArray[np.uint8]
FRAMES, SEED, OTHER_SEED = 300, 1400, 1401
BROKEN = range(120, 125)
LONG = range(120, 120 + round(10 * FPS))
OVERRIDES = ("mapping.enabled=false", "output.report=false", "output.keep=nothing")


@dataclass(frozen=True)
class Drive:
    """Images with stamps ``(N,)`` and true poses ``(N, 4, 4)``; ``shows_road`` ``(N,)`` where the image is whole."""

    images: list[Image]
    stamps: FloatArray
    T_world_camera: FloatArray
    shows_road: NDArray[np.bool_]

    def changed(self, frames: Sequence[int], change: Callable[[Image, int], Image], shows_road: bool) -> Drive:
        """The drive with other images at some frames."""
        images, shown = list(self.images), self.shows_road.copy()
        for k in frames:
            images[k], shown[k] = change(self.images[k], k), shows_road
        return replace(self, images=images, shows_road=shown)

    def selected(self, rows: Sequence[int], stamps: FloatArray) -> Drive:
        """Some frames, in the order given."""
        chosen = np.array(rows)
        return Drive([self.images[k] for k in rows], stamps, self.T_world_camera[chosen], self.shows_road[chosen])


def simulated(frames: int, seed: int) -> tuple[Drive, SimulatedSequence]:
    """The clean drive of a simulated world."""
    sequence = SimulatedSequence(SimulationOptions(route="grid", frames=frames, seed=seed))
    return whole(sequence), sequence


def whole(sequence: FrameSequence) -> Drive:
    """All frames of a sequence with true poses."""
    frames = len(sequence)
    images = [sequence.frame(k).image for k in range(frames)]
    return Drive(images, sequence.stamps, np.asarray(sequence.reference), np.ones(frames, bool))


def _encoded(image: Image, quality: int) -> Image:
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)


def _noise(image: Image, k: int) -> Image:
    return np.random.default_rng(k).integers(0, 256, image.shape, np.uint8)


def _frozen(drive: Drive, copy: Callable[[Image, int], Image]) -> Drive:
    last = drive.images[BROKEN[0] - 1]
    return drive.changed(BROKEN, lambda _, k: copy(last, k), shows_road=False)


def _half_covered(image: Image, _: int) -> Image:
    covered = image.copy()
    covered[:, : image.shape[1] // 2] = 0
    return covered


def _exposed(image: Image, k: int) -> Image:
    return np.asarray(np.clip(image * (1.0 + 0.6 * np.sin(0.4 * k)), 0, 255), np.uint8)


def _wiped(image: Image, k: int) -> Image:
    height, width = image.shape[:2]
    angle = np.deg2rad(15 + 150 * (0.5 - 0.5 * np.cos(0.9 * k)))
    foot = (width // 2, height + height // 4)
    tip = (round(foot[0] + 2 * width * np.cos(angle)), round(foot[1] - 2 * width * np.sin(angle)))
    return np.asarray(cv2.line(image.copy(), foot, tip, (10, 10, 10), width // 16), np.uint8)


def _dark(image: Image, k: int) -> Image:
    noise = np.random.default_rng(k).normal(0, 1, image.shape)
    return np.asarray(np.clip(0.01 * image + noise, 0, 255), np.uint8)


def _cut(drive: Drive) -> Drive:
    """The second half is of another town."""
    half, other = len(drive.images) // 2, simulated(len(drive.images), OTHER_SEED)[0]
    poses = np.concatenate([drive.T_world_camera[:half], drive.T_world_camera[half] @ other.T_world_camera[:half]])
    return replace(drive, images=drive.images[:half] + other.images[:half], T_world_camera=poses)


def _dropped(drive: Drive) -> Drive:
    rows = [k for k in range(len(drive.images)) if k not in (120, 121, 180)]
    return drive.selected(rows, drive.stamps[rows])


def _doubled(drive: Drive) -> Drive:
    rows = sorted([*range(len(drive.images)), 120, 180, 181])
    return drive.selected(rows, np.arange(len(rows)) / FPS)


def swapped_stamps(drive: Drive, row: int = 120) -> Drive:
    """Two stamps are exchanged."""
    stamps = drive.stamps.copy()
    stamps[[row, row + 1]] = stamps[[row + 1, row]]
    return replace(drive, stamps=stamps)


FAULTS: dict[str, Callable[[Drive], Drive]] = {
    "clean": lambda drive: drive,
    "black": lambda drive: drive.changed(BROKEN, lambda image, _: np.zeros_like(image), shows_road=False),
    "white": lambda drive: drive.changed(BROKEN, lambda image, _: np.full_like(image, 255), shows_road=False),
    "noise": lambda drive: drive.changed(BROKEN, _noise, shows_road=False),
    "frozen exact": lambda drive: _frozen(drive, lambda image, _: image),
    "frozen, encoded once": lambda drive: _frozen(drive, lambda image, _: _encoded(image, 80)),
    "frozen, encoded each time": lambda drive: _frozen(drive, lambda image, k: _encoded(image, 60 + 7 * (k % 5))),
    "upside down": lambda drive: drive.changed(BROKEN, lambda image, _: image[::-1, ::-1].copy(), shows_road=False),
    "mirrored": lambda drive: drive.changed(BROKEN, lambda image, _: image[:, ::-1].copy(), shows_road=False),
    "half covered": lambda drive: drive.changed(range(120, 140), _half_covered, shows_road=True),
    "rolling exposure": lambda drive: drive.changed(range(len(drive.images)), _exposed, shows_road=True),
    "dropped frames": _dropped,
    "doubled frames": _doubled,
    "stamps out of order": swapped_stamps,
    "cut to another place": _cut,
    "wiper": lambda drive: drive.changed(range(120, 180), _wiped, shows_road=True),
    "ten seconds of darkness": lambda drive: drive.changed(LONG, _dark, shows_road=False),
}


@dataclass(frozen=True)
class Outcome:
    """Error of a drive in metres, None where it was refused, and the warnings or the refusal."""

    fault: str
    ate_rmse_m: float | None
    reported: tuple[str, ...]


def write_root(root: Path, drive: Drive, sequence: FrameSequence, focal_ratio: float = 1.0) -> None:
    """A KITTI odometry root with the camera of a sequence, or with another focal length."""
    intrinsics = sequence.intrinsics
    intrinsics = replace(intrinsics, fx=focal_ratio * intrinsics.fx, fy=focal_ratio * intrinsics.fy)
    T_camera_lidar = np.eye(4) if sequence.T_camera_lidar is None else np.asarray(sequence.T_camera_lidar)
    folder = root / "sequences" / "sim"
    (folder / "image_2").mkdir(parents=True)
    (root / "poses").mkdir()
    for k, image in enumerate(drive.images):
        write_image(folder / "image_2" / f"{k:06d}.png", image)
    write_calibration(folder / "calib.txt", intrinsics.K, T_camera_lidar)
    write_lines(folder / "times.txt", [f"{stamp:.6e}" for stamp in drive.stamps])
    write_poses(root / "poses" / "sim.txt", drive.T_world_camera)
    camera = {name: getattr(intrinsics, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    camera |= {"fps": FPS, "camera_height_m": sequence.camera_height_m}
    write_lines(root / "camera.yaml", [f"{key}: {value}" for key, value in camera.items()])


class _Warnings(logging.Handler):
    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(record.getMessage())


def examine(fault: str, drive: Drive, sequence: SimulatedSequence, weights: str) -> Outcome:
    """Run one broken drive through the public door."""
    with tempfile.TemporaryDirectory() as place:
        root, said = Path(place) / "root", _Warnings()
        write_root(root, drive, sequence)
        logging.getLogger("slam").addHandler(said)
        try:
            run = run_slam(root, "sim", weights=weights, output=Path(place) / "run", overrides=OVERRIDES)
        except SlamError as error:
            return Outcome(fault, None, (str(error).replace(str(root), "ROOT"),))
        finally:
            logging.getLogger("slam").removeHandler(said)
        trajectory = run.trajectory("optimised")
        assert trajectory is not None
        segments = _segments(run.metrics().sequence)
        shown = np.flatnonzero(drive.shows_road)
        rmse = ate(trajectory.T_world_camera, drive.T_world_camera, shown, segments)
        return Outcome(fault, rmse, tuple(line.replace(str(root), "ROOT") for line in said.lines))


def _segments(sequence: SequenceMetrics | Missing) -> list[tuple[int, int]]:
    """First and last frame of each segment; a long gap belongs to the one before it."""
    begins, frames = [each.first for each in sequence.segments], known(sequence.frames) or 0
    return list(zip(begins, [*(first - 1 for first in begins[1:]), frames - 1], strict=True))


def ate(
    T_estimate: FloatArray, T_reference: FloatArray, frames: NDArray[np.intp], segments: Sequence[tuple[int, int]]
) -> float:
    """Root mean square distance of positions, each segment aligned by a similarity, metres."""
    squares = []
    for first, last in segments:
        rows = frames[(frames >= first) & (frames <= last)]
        if not len(rows):  # a segment of broken frames alone
            continue
        true, estimated = T_reference[rows], T_estimate[rows]
        similarity = umeyama(true[:, :3, 3], estimated[:, :3, 3], with_scale=True)
        moved = similarity.apply_to_poses(estimated)
        squares.append(((moved - true)[:, :3, 3] ** 2).sum(axis=1))
    return float(np.sqrt(np.concatenate(squares).mean()))


def main(words: Sequence[str] | None = None) -> None:
    """Run broken drives and print one row of a table each."""
    parser = parser_of(__doc__)
    parser.add_argument("--fault", action="append", choices=list(FAULTS))
    parser.add_argument("--frames", type=int, default=FRAMES)
    parser.add_argument("--weights", default="sim")
    options = parser.parse_args(words)
    clean, sequence = simulated(options.frames, SEED)
    whole = examine("clean", clean, sequence, options.weights)
    print("| fault | ATE, m | over the clean drive's | reported |\n|---|---|---|---|")
    for fault in options.fault or FAULTS:
        found = whole if fault == "clean" else examine(fault, FAULTS[fault](clean), sequence, options.weights)
        print(_row(found, whole), flush=True)


def _row(found: Outcome, whole: Outcome) -> str:
    reported = "; ".join(found.reported) or "nothing"
    if found.ate_rmse_m is None or whole.ate_rmse_m is None:
        return f"| {found.fault} | - | - | refused: {reported} |"
    return f"| {found.fault} | {found.ate_rmse_m:.2f} | {found.ate_rmse_m / whole.ate_rmse_m:.1f} | {reported} |"


if __name__ == "__main__":
    main()
