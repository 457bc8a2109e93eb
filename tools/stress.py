"""Drives that are broken or odd: their error, the confidence that the run has in itself, and what it says.

Without --dataset the changes are made to simulated worlds, as they are and in all weathers at once. Errors are over 6
dof, in percent of the path; the confidence is that of metrics.json.

--fit RUNS fits the constants of the confidence to kept run folders, and judges it on drives that the fit did not see. A
run is right if it errs by at most 1 % of its path. A drive is left out with all its changes. Runs with a wrong focal
length are judged, but not fitted: where nothing turns nothing shows it.

Example: python tools/stress.py --dataset KITTI_ROOT --sequence 00 --frames 100:200
Example: python tools/stress.py --fit RUNS
"""

from __future__ import annotations

import re
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import get_args

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from shared.command import one_line_errors, parser_of

from erfsfm.common.table import Table
from slam import run_slam
from slam.formats.trajectory import Trajectory, write_kitti
from slam.frames import Sequence as FrameSequence
from slam.frontend.agreement import CONFIDENCE, share_right
from slam.geometry.se3 import FloatArray
from slam.results.folder import RunFolder
from slam.runtime.errors import SlamError
from slam.sequences.catalogue import open_sequence
from slam.simulation.options import Hazard, SimulationOptions
from slam.simulation.recording import SimulatedSequence, write_image, write_lines

Image = NDArray[np.uint8]
WORDS = (
    "every word of this line hides a part of the road",
    "and the next line hides another part of it",
)
FRAMES = 110
RIGHT = 0.01  # of the path
FOCAL = "focal"  # in the names of runs with a wrong focal length
BINS = (0.0, 0.3, 0.6, 0.85, 1.0)
OVERRIDES = ("mapping.enabled=false", "output.report=false")


@dataclass(frozen=True)
class Drive:
    """Images at ``stamps`` ``(N,)`` with true poses ``(N, 4, 4)``; the focal length that is told over the true one."""

    images: list[Image]
    stamps: FloatArray
    T_world_camera: FloatArray
    focal_ratio: float = 1.0

    def rows(self, rows: Sequence[int]) -> Drive:
        """These frames in this order, at even times."""
        stamps = self.stamps[0] + np.median(np.diff(self.stamps)) * np.arange(len(rows))
        return Drive([self.images[k] for k in rows], stamps, self.T_world_camera[list(rows)])


def everywhere(change: Callable[[Image, int], Image]) -> Callable[[Drive], Drive]:
    """Every image is changed, by its number."""
    return lambda drive: replace(
        drive, images=[change(image, k) for k, image in enumerate(drive.images)]
    )


def in_between(
    change: Callable[[Image, int], Image], share: float = 0.05
) -> Callable[[Drive], Drive]:
    """A share of the images, after the first half, is changed."""

    def changed(drive: Drive) -> Drive:
        first, count = len(drive.images) // 2, max(round(share * len(drive.images)), 2)
        chosen = range(first, first + count)
        return everywhere(lambda image, k: change(image, k) if k in chosen else image)(drive)

    return changed


def _zoomed(image: Image, ratio: float) -> Image:
    height, width = image.shape[:2]
    M = np.array([[ratio, 0, (1 - ratio) * width / 2], [0, ratio, (1 - ratio) * height / 2]])
    return np.asarray(cv2.warpAffine(image, M, (width, height)), np.uint8)


def _subtitled(image: Image, k: int) -> Image:
    height, width = image.shape[:2]
    size, titled = height / 300, image.copy()
    for line, row in zip(WORDS if k // 15 % 2 else WORDS[::-1], (0.8, 0.91)):
        for grey, thickness in ((0, max(round(4 * size), 2)), (255, max(round(1.5 * size), 1))):
            corner = round(0.1 * width), round(row * height)
            cv2.putText(
                titled,
                line,
                corner,
                cv2.FONT_HERSHEY_SIMPLEX,
                size,
                (grey,) * 3,
                thickness,
                cv2.LINE_AA,
            )
    return titled


def _texture(seed: int, height: int, width: int) -> Image:
    coarse = (
        np.random.default_rng(seed).integers(30, 220, (height // 6, width // 6, 3)).astype(np.uint8)
    )
    return np.asarray(cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC), np.uint8)


def _bonneted(image: Image, _: int) -> Image:
    height, width = image.shape[:2]
    axes = round(0.45 * width), round(0.33 * height)
    mask = cv2.ellipse(
        np.zeros((height, width), np.uint8),
        (width // 2, round(1.05 * height)),
        axes,
        0,
        0,
        360,
        1,
        -1,
    )
    return np.where(mask[..., None] > 0, _texture(3, height, width), image)


def _passed(image: Image, k: int) -> Image:
    """Behind a textured block of 60 % x 80 % of the image, which crosses it at a fiftieth of its width a frame."""
    height, width = image.shape[:2]
    rows, columns = round(0.8 * height), round(0.6 * width)
    M, passing = (
        np.array([[1.0, 0.0, k * width / 50 - columns], [0.0, 1.0, height - rows]]),
        image.copy(),
    )
    cv2.warpAffine(
        _texture(4, rows, columns), M, (width, height), passing, borderMode=cv2.BORDER_TRANSPARENT
    )
    return passing


def _noisy(image: Image, k: int, gain: float = 1.0, sigma: float = 25.0) -> Image:
    noise = np.random.default_rng(k).normal(0, sigma, image.shape)
    return np.asarray(np.clip(gain * image + noise, 0, 255), np.uint8)


CHANGES: dict[str, Callable[[Drive], Drive]] = {
    "as it is": lambda drive: drive,
    "black images": in_between(lambda image, _: np.zeros_like(image)),
    "noise for images": in_between(
        lambda image, k: np.random.default_rng(k).integers(0, 256, image.shape, np.uint8)
    ),
    "mirrored images": in_between(lambda image, _: image[:, ::-1].copy()),
    "darkness": in_between(partial(_noisy, gain=0.01, sigma=1.0), 0.3),
    "doubled frames": lambda d: d.rows(
        sorted([*range(len(d.images)), *range(20, len(d.images), 40)])
    ),
    "stamps out of order": lambda d: replace(
        d, stamps=d.stamps[[0, 2, 1, *range(3, len(d.stamps))]]
    ),
    "every fifth frame": lambda d: d.rows(range(0, len(d.images), 5)),
    "zoom by 1.5 in the middle": lambda d: everywhere(
        lambda i, k: _zoomed(i, 1.5 if 2 * k >= len(d.images) else 1)
    )(d),
    "zoom by 1.5 all the time": lambda d: everywhere(
        lambda i, k: _zoomed(i, 1 + 0.5 * k / len(d.images))
    )(d),
    "black bars": everywhere(
        lambda image, _: image * (abs(np.linspace(-1, 1, len(image))) < 0.72)[:, None, None]
    ),
    "subtitles": everywhere(_subtitled),
    "patterned bonnet": everywhere(_bonneted),
    "a block that passes": everywhere(_passed),
    "night": everywhere(partial(_noisy, gain=0.15, sigma=9.0)),
    "noise": everywhere(_noisy),
    "the first half twice": lambda d: d.rows(
        [*range(len(d.images) // 2), *range(len(d.images) // 2)]
    ),
    "focal length 1.3 times too large": lambda d: replace(d, focal_ratio=1.3),
}


def run(drive: Drive, camera: FrameSequence, weights: str, place: Path, output: Path) -> RunFolder:
    """Write the images with their camera and true poses, and run them through the public door."""
    lines = {name: getattr(camera.intrinsics, name) for name in ("width", "height", "cx", "cy")}
    lines |= {name: drive.focal_ratio * getattr(camera.intrinsics, name) for name in ("fx", "fy")}
    lines |= {"fps": 10, "camera_height_m": camera.camera_height_m or "unknown"}
    (place / "images").mkdir()
    for k, image in enumerate(drive.images):
        write_image(place / "images" / f"{k:06d}.png", image)
    write_lines(place / "camera.yaml", [f"{key}: {value}" for key, value in lines.items()])
    write_lines(place / "times.txt", [f"{stamp:.6f}" for stamp in drive.stamps])
    write_kitti(
        place / "truth.txt",
        Trajectory(np.arange(len(drive.stamps), dtype=float), drive.T_world_camera),
    )
    return run_slam(
        place, weights=weights, truth=place / "truth.txt", output=output, overrides=OVERRIDES
    )


def row(
    name: str, drive: Drive, camera: FrameSequence, weights: str, keep: Path | None
) -> list[str]:
    """Of the table: the drive, its error and confidence, and the refusal or what was bridged, cut and doubted most."""
    with tempfile.TemporaryDirectory() as place:
        try:
            metrics = run(
                drive, camera, weights, Path(place), (keep or Path(place)) / name
            ).metrics()
        except SlamError as refusal:
            return [name, "-", "-", f"refused: {refusal}".replace(place, "ROOT")]
    ate_m, length_m = (
        metrics.trajectories.optimised.align.dof6.ate_rmse_m,
        metrics.sequence.length_m,
    )
    percent = 100 * ate_m / length_m if ate_m is not None and length_m else np.nan
    worst = max(metrics.agreement or [], key=lambda each: each.sigmas or 0.0)
    said = [f"{gap.first} to {gap.last}: {gap.reason}" for gap in metrics.sequence.bridged or ()]
    said += [
        f"a segment begins at {segment.first}" for segment in (metrics.sequence.segments or [])[1:]
    ]
    said.append(f"{worst.source}, {worst.sigmas:.1f} sigmas")
    return [name, f"{percent:.1f}", f"{metrics.confidence.run or 0.0:.2f}", "; ".join(said)]


def outcomes(runs: Path) -> tuple[NDArray[np.str_], FloatArray, NDArray[np.bool_]]:
    """Of run folders with a truth and metres: names, largest contradictions ``(N,)`` in sigmas, and which are right."""
    found: list[tuple[str, float, bool]] = []
    for path in sorted(runs.iterdir()):
        metrics = RunFolder(path).metrics()
        ate_m, length_m = (
            metrics.trajectories.optimised.align.dof6.ate_rmse_m,
            metrics.sequence.length_m,
        )
        if ate_m is not None and length_m and metrics.is_metric and metrics.tracking.absent:
            sigmas = max(each.sigmas or 0.0 for each in metrics.agreement or ())
            found.append((path.name, sigmas, ate_m / length_m <= RIGHT))
    names, sigmas_of, right = zip(*found)
    return np.array(names), np.array(sigmas_of), np.array(right)


def constants(sigmas: FloatArray, right: NDArray[np.bool_]) -> tuple[float, float, float]:
    """With the likeliest sigmas that halve the confidence; too few drives lie between to fit the other two."""
    best, _, steepness = CONFIDENCE

    def loss(half: float) -> float:
        share = share_right(sigmas, (best, half, steepness))
        return -float(np.log(np.where(right, share, 1.0 - share)).sum())

    return best, float(minimize_scalar(loss, bounds=(1.0, 5.0), method="bounded").x), steepness


def judge_confidence(runs: Path) -> None:
    """Print what the confidence of runs is worth on drives left out, and the constants that all of them give."""
    names, every_sigmas, every_right = outcomes(runs)
    told_right = np.array([FOCAL not in name for name in names])
    sigmas, right = every_sigmas[told_right], every_right[told_right]
    drives = np.array([re.split(r"[\[,]", name)[0] for name in names[told_right]])
    stated = np.zeros(len(drives))
    for drive in np.unique(drives):
        held_out = drives == drive
        stated[held_out] = share_right(
            sigmas[held_out], constants(sigmas[~held_out], right[~held_out])
        )
    rows = []
    for least, most in pairwise(BINS):
        among = (stated >= least) & (stated < most)
        shares = [f"{part[among].mean():.2f}" if among.any() else "-" for part in (stated, right)]
        rows.append([f"{least:g} to {most:g}", str(among.sum()), *shares])
    print(Table(("confidence by the other drives", "runs", "mean", "share right"), rows).markdown())
    constant = np.full(len(drives), right.mean())
    scores = [
        np.square(each - right).mean()
        for each in (stated, share_right(sigmas, CONFIDENCE), constant)
    ]
    print(
        "Brier score {:.3f} by the other drives, {:.3f} as in use, {:.3f} of a constant".format(
            *scores
        )
    )
    print(f"best, half and steepness {constants(sigmas, right)} by all drives, {CONFIDENCE} in use")
    for name, one, is_right in zip(names, every_sigmas, every_right):
        if FOCAL in name:
            print(f"{name}: {'right' if is_right else 'wrong'}, {share_right(one, CONFIDENCE):.2f}")


@one_line_errors()
def main(words: Sequence[str] | None = None) -> None:
    """Run all drives and print a row of a table each."""
    parser = parser_of(__doc__)
    add = parser.add_argument
    add("--dataset", type=Path, help="a data set with true poses; else simulated worlds")
    add("--sequence")
    add("--frames", help="A:B, half-open")
    add("--seeds", help="A:B, of simulated worlds", default="840:846")
    add("--change", action="append", choices=list(CHANGES), help="default: every one; repeat")
    add("--weights", default="default")
    add("--keep", type=Path, help="folder for the run folders")
    add(
        "--fit",
        type=Path,
        metavar="RUNS",
        help="judge the confidence of kept runs in place of running",
    )
    o = parser.parse_args(words)
    if o.fit is not None:
        judge_confidence(o.fit)
        return
    cameras: list[FrameSequence] = []
    if o.dataset is not None:
        cameras.append(open_sequence(o.dataset, o.sequence, frames=o.frames))
    else:
        options = [
            SimulationOptions("grid", FRAMES, seed) for seed in range(*map(int, o.seeds.split(":")))
        ]
        options += [replace(each, hazards=get_args(Hazard)) for each in options]
        cameras += map(SimulatedSequence, options)
    rows = []
    for camera in cameras:
        images = [camera.frame(k).image for k in range(len(camera))]
        drive = Drive(images, camera.stamps, np.asarray(camera.reference))
        for change in o.change or CHANGES:
            rows.append(
                row(f"{camera.name}, {change}", CHANGES[change](drive), camera, o.weights, o.keep)
            )
            print(*rows[-1][:3], file=sys.stderr)
    print(Table(("drive", "error, % of the path", "confidence", "said"), rows, names=4).markdown())


if __name__ == "__main__":
    main()
