"""Fit the confidence of runs to drives with true poses, and judge it on drives that the fit did not see.

Reads run folders by the name DRIVE or ``DRIVE, ODDITY``, as ``stress.py --keep RUNS`` leaves them. A run is right
if it errs by at most 1 % of its path (6 dof). A drive is left out with all its oddities. Runs with a wrong focal length
are judged, but not fitted: where nothing turns nothing shows it.

The constants in use are of commit cae833d3 with ``default`` weights and without a map: whole KITTI 00, 02, 05 (300
frames each), raw drive 0013, 110 frames of KITTI 03, ten simulated worlds (seeds 620 to 629, clean and with all
hazards), and 60 frames (all of them where frames are dropped) of 00, 02, 05, 0013 and worlds 621 and 623 as
``stress.py`` changes them.

Example: python tools/fit_confidence.py RUNS
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.optimize import minimize_scalar
from shared.command import one_line_errors, parser_of

from erfsfm.common.table import Table
from slam.frontend.agreement import CONFIDENCE, share_right
from slam.geometry.se3 import FloatArray
from slam.results.folder import RunFolder

RIGHT = 0.01  # of the path
FOCAL = "focal"  # in the names of runs with a wrong focal length
BINS = (0.0, 0.3, 0.6, 0.85, 1.0)


@dataclass(frozen=True)
class Outcome:
    """The largest contradiction of a run, in sigmas, and its error over its path."""

    name: str
    sigmas: float
    error: float

    @property
    def drive(self) -> str:
        """Whose images these are."""
        return re.split(r"[\[,]", self.name)[0]


def outcomes(runs: Path) -> Iterator[Outcome]:
    """Of the run folders in a folder that have a truth and metres."""
    for path in sorted(runs.iterdir()):
        metrics = RunFolder(path).metrics()
        ate_m, length_m = metrics.trajectories.optimised.align.dof6.ate_rmse_m, metrics.sequence.length_m
        if ate_m is not None and length_m and metrics.is_metric and metrics.tracking.absent:
            sigmas = max(each.sigmas or 0.0 for each in metrics.agreement or ())
            yield Outcome(path.name, sigmas, ate_m / length_m)


def fit(found: Sequence[Outcome]) -> tuple[float, float, float]:
    """Constants with the likeliest sigmas that halve the confidence; too few drives lie between to fit the others."""
    sigmas = np.array([each.sigmas for each in found])
    right = np.array([each.error <= RIGHT for each in found])
    best, _, steepness = CONFIDENCE

    def loss(half: float) -> float:
        share = share_right(sigmas, (best, half, steepness))
        return -float(np.log(np.where(right, share, 1.0 - share)).sum())

    return best, float(minimize_scalar(loss, bounds=(1.0, 5.0), method="bounded").x), steepness


def brier(found: Sequence[Outcome], stated: FloatArray) -> float:
    """Mean squared difference of the stated shares ``(N,)`` and of what became of the runs."""
    return float(np.mean((stated - [each.error <= RIGHT for each in found]) ** 2))


def rows(found: Sequence[Outcome], stated: FloatArray) -> Iterator[list[str]]:
    """Runs by their stated confidence ``(N,)``: how many, the mean of it, and how many are right."""
    for least, most in pairwise(BINS):
        among = [k for k, share in enumerate(stated) if least <= share < most]
        right = sum(found[k].error <= RIGHT for k in among)
        mean = f"{stated[among].mean():.2f}" if among else "-"
        yield [f"{least:g} to {most:g}", str(len(among)), mean, f"{right / len(among):.2f}" if among else "-"]


@one_line_errors()
def main(words: Sequence[str] | None = None) -> None:
    """Fit, and print what the confidence is worth on drives left out."""
    parser = parser_of(__doc__)
    parser.add_argument("runs", type=Path, help="folder of run folders")
    options = parser.parse_args(words)
    every = list(outcomes(options.runs))
    known_cameras = [each for each in every if FOCAL not in each.name]
    constants = {
        drive: fit([each for each in known_cameras if each.drive != drive])
        for drive in {each.drive for each in known_cameras}
    }
    stated = np.array([share_right(each.sigmas, constants[each.drive]) for each in known_cameras])
    right = np.mean([each.error <= RIGHT for each in known_cameras])
    head = ("confidence by the other drives", "runs", "mean", "share right")
    print(Table(head, list(rows(known_cameras, stated))).markdown())
    in_use = np.array([share_right(each.sigmas, CONFIDENCE) for each in known_cameras])
    scores = brier(known_cameras, stated), brier(known_cameras, in_use), right * (1 - right)
    print("Brier score {:.3f} by the other drives, {:.3f} as in use, {:.3f} of a constant".format(*scores))
    print(f"best, half and steepness {fit(known_cameras)} by all drives, {CONFIDENCE} in use")
    for each in every:
        if FOCAL in each.name:
            print(f"{each.name}: {100 * each.error:.1f} %, {share_right(each.sigmas, CONFIDENCE):.2f}")


if __name__ == "__main__":
    main()
