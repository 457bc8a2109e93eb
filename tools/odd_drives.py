"""Drives that are odd from end to end: their error and the confidence that the run has in itself.

Zoom, bars, subtitles, a bonnet, night, missing frames, a wrong focal length, on simulated worlds and in their weather,
or on a piece of a recording with true poses. The confidence is that of metrics.json; errors are over 6 dof, in percent
of the path.

Example: python tools/odd_drives.py --dataset KITTI_ROOT --sequence 00 --frames 100:200 --weights default
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import cv2
import numpy as np
from broken_drives import OVERRIDES, Drive, Image, whole, write_root
from shared.command import markdown, one_line_errors, parser_of

from slam import run_slam
from slam.frames import Sequence as FrameSequence
from slam.runtime.errors import SlamError
from slam.runtime.storage.record import known
from slam.sequences.catalogue import open_sequence
from slam.sequences.simulated import SimulatedSequence
from slam.simulation.hazards import Hazard
from slam.simulation.options import SimulationOptions

WORDS = ("every word of this line hides a part of the road", "and the next line hides another part of it")
FRAMES = 110


def _zoomed(image: Image, ratio: float) -> Image:
    height, width = image.shape[:2]
    M = np.array([[ratio, 0, (1 - ratio) * width / 2], [0, ratio, (1 - ratio) * height / 2]])
    return np.asarray(cv2.warpAffine(image, M, (width, height)), np.uint8)


def _barred(image: Image, _: int) -> Image:
    barred, rows = image.copy(), round(0.14 * len(image))
    barred[:rows] = barred[-rows:] = 0
    return barred


def _written(image: Image, text: str, place: tuple[float, float]) -> Image:
    height, width = image.shape[:2]
    size, corner = height / 300, (round(width * place[0]), round(height * place[1]))
    for grey, thickness in ((0, max(round(4 * size), 2)), (255, max(round(1.5 * size), 1))):
        image = cv2.putText(image, text, corner, cv2.FONT_HERSHEY_SIMPLEX, size, (grey,) * 3, thickness, cv2.LINE_AA)
    return np.asarray(image, np.uint8)


def _subtitled(image: Image, k: int) -> Image:
    first, second = WORDS if k // 15 % 2 else WORDS[::-1]
    return _written(_written(image.copy(), first, (0.1, 0.8)), second, (0.1, 0.91))


def _rolling(image: Image, k: int) -> Image:
    height, width = image.shape[:2]
    band = cv2.rectangle(image.copy(), (0, round(0.82 * height)), (width, round(0.95 * height)), (30,) * 3, -1)
    return _written(np.asarray(band, np.uint8), "  ".join(WORDS), (0.9 - 0.03 * k, 0.92))


def _bonneted(image: Image, _: int) -> Image:
    height, width = image.shape[:2]
    texture = np.random.default_rng(3).integers(30, 220, (height // 6, width // 6, 3)).astype(np.uint8)
    bonnet = cv2.resize(texture, (width, height), interpolation=cv2.INTER_CUBIC)
    axes = round(0.45 * width), round(0.33 * height)
    mask = cv2.ellipse(np.zeros((height, width), np.uint8), (width // 2, round(1.05 * height)), axes, 0, 0, 360, 1, -1)
    return np.where(mask[..., None] > 0, bonnet, image)


def _at_night(image: Image, k: int) -> Image:
    dark = 60 * (image / 255.0) ** 1.5 + np.random.default_rng(k).normal(0, 9, image.shape)
    return np.asarray(np.clip(dark, 0, 255), np.uint8)


def _noisy(image: Image, k: int) -> Image:
    return np.asarray(np.clip(image + np.random.default_rng(k).normal(0, 25, image.shape), 0, 255), np.uint8)


def _passed(image: Image, k: int) -> Image:
    """Behind a textured block of 60 % x 80 % of the image, which crosses it at a fiftieth of its width a frame."""
    height, width = image.shape[:2]
    rows, columns = round(0.8 * height), round(0.6 * width)
    texture = np.random.default_rng(4).integers(30, 220, (rows // 8, columns // 8, 3)).astype(np.uint8)
    block = cv2.resize(texture, (columns, rows), interpolation=cv2.INTER_CUBIC)
    M = np.array([[1.0, 0.0, k * width / 50 - columns], [0.0, 1.0, height - rows]])
    passing = image.copy()
    cv2.warpAffine(block, M, (width, height), passing, borderMode=cv2.BORDER_TRANSPARENT)
    return passing


def _every(stride: int) -> Callable[[Drive], Drive]:
    return lambda drive: drive.selected(range(0, len(drive.images), stride), drive.stamps[::stride])


def _changed(change: Callable[[Image, int], Image]) -> Callable[[Drive], Drive]:
    return lambda drive: drive.changed(range(len(drive.images)), change, shows_road=True)


def _zooming(drive: Drive) -> Drive:
    return _changed(lambda image, k: _zoomed(image, 1 + 0.5 * k / len(drive.images)))(drive)


def _zooms(drive: Drive) -> Drive:
    half = len(drive.images) // 2
    return _changed(lambda image, k: _zoomed(image, 1.5) if k >= half else image)(drive)


def _twice(drive: Drive) -> Drive:
    half = len(drive.images) // 2
    return drive.selected([*range(half), *range(half)], drive.stamps[: 2 * half])


ODDITIES: dict[str, Callable[[Drive], Drive]] = {
    "as it is": lambda drive: drive,
    "every second frame": _every(2),
    "every fifth frame": _every(5),
    "every tenth frame": _every(10),
    "zoom by 1.5 in the middle": _zooms,
    "zoom by 1.5 all the time": _zooming,
    "black bars": _changed(_barred),
    "subtitles": _changed(_subtitled),
    "rolling subtitles": _changed(_rolling),
    "patterned bonnet": _changed(_bonneted),
    "night": _changed(_at_night),
    "noise": _changed(_noisy),
    "a block that passes": _changed(_passed),
    "the first half twice": _twice,
}
FOCAL = "focal length 1.3 times too large"  # of the camera, not of its images


@dataclass(frozen=True)
class OddDrive:
    """A drive with the camera that took it, and the ratio of the focal length that the run is told to the true one."""

    name: str
    drive: Drive
    camera: FrameSequence
    focal_ratio: float = 1.0


@dataclass(frozen=True)
class Outcome:
    """Error in percent of the path and confidence of a drive, NaN where it was refused; what is doubted most."""

    name: str
    error_percent: float
    confidence: float
    doubt: str

    def row(self) -> list[str]:
        """The cells of a table."""
        return [self.name, f"{self.error_percent:.1f}", f"{self.confidence:.2f}", self.doubt]


def examine(odd: OddDrive, weights: str, keep: Path | None) -> Outcome:
    """Run one drive through the public door; its run folder lies in ``keep``, where that is given."""
    with tempfile.TemporaryDirectory() as place:
        root, name = Path(place) / "root", odd.name
        write_root(root, odd.drive, odd.camera, odd.focal_ratio)
        try:
            run = run_slam(root, "sim", weights=weights, output=(keep or Path(place)) / name, overrides=OVERRIDES)
        except SlamError as error:
            return Outcome(name, np.nan, np.nan, f"refused: {error}".replace(str(root), "ROOT"))
        metrics = run.metrics()
    ate_m = known(metrics.trajectories.optimised.align.dof6.ate_rmse_m)
    length_m = known(metrics.sequence.length_m)
    percent = 100 * ate_m / length_m if ate_m is not None and length_m else np.nan
    worst = max(known(metrics.agreement) or [], key=lambda each: known(each.sigmas) or 0.0)
    doubt = f"{worst.source}, {known(worst.sigmas):.1f} sigmas"
    return Outcome(name, percent, known(metrics.confidence.run) or 0.0, doubt)


def _of_recording(dataset: Path, name: str | None, frames: str | None) -> Iterator[OddDrive]:
    """Every oddity of a piece of a recording."""
    piece = open_sequence(dataset, name, frames=frames)
    drive = whole(piece)
    for oddity, change in ODDITIES.items():
        yield OddDrive(f"{piece.name}, {oddity}", change(drive), piece)
    yield OddDrive(f"{piece.name}, {FOCAL}", drive, piece, focal_ratio=1.3)


def _simulated(seeds: range) -> Iterator[OddDrive]:
    """Worlds as they are and in each weather; of every third seed all oddities."""
    weathers = [(), *((hazard,) for hazard in get_args(Hazard)), get_args(Hazard)]
    for seed in seeds:
        for weather in weathers:
            camera = SimulatedSequence(SimulationOptions("grid", FRAMES, seed, hazards=weather))
            yield OddDrive(f"world {seed}, {', '.join(weather) or 'as it is'}", whole(camera), camera)
        if seed % 3 == 0:
            camera = SimulatedSequence(SimulationOptions("grid", FRAMES, seed))
            drive = whole(camera)
            for oddity in list(ODDITIES)[1:]:
                yield OddDrive(f"world {seed}, {oddity}", ODDITIES[oddity](drive), camera)
            yield OddDrive(f"world {seed}, {FOCAL}", drive, camera, focal_ratio=1.3)


@one_line_errors()
def main(words: Sequence[str] | None = None) -> None:
    """Run odd drives and print a row of a table each."""
    parser = parser_of(__doc__)
    parser.add_argument("--dataset", type=Path, help="a data set with true poses; else simulated worlds")
    parser.add_argument("--sequence")
    parser.add_argument("--frames", help="A:B, half-open")
    parser.add_argument("--seeds", help="A:B, of simulated worlds", default="840:846")
    parser.add_argument("--weights", default="default")
    parser.add_argument("--keep", type=Path, help="folder for the run folders, which fit_confidence.py reads")
    options = parser.parse_args(words)
    if options.dataset is not None:
        drives = _of_recording(options.dataset, options.sequence, options.frames)
    else:
        drives = _simulated(range(*map(int, options.seeds.split(":"))))
    outcomes = []
    for odd in drives:
        outcomes.append(outcome := examine(odd, options.weights, options.keep))
        print(f"{outcome.name}: {outcome.error_percent:.1f} %, confidence {outcome.confidence:.2f}", file=sys.stderr)
    print(markdown(("drive", "error, % of the path", "confidence", "largest doubt"), [o.row() for o in outcomes]))


if __name__ == "__main__":
    main()
