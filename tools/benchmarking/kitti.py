"""Whole sequences of KITTI odometry: which are there, how long they take, and their errors beside published ones."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean
from typing import NamedTuple

from benchmarking import metrics as m
from benchmarking.plan import Job
from benchmarking.work import JobResult, is_done, job_result

from erfsfm.common.table import DASH
from slam.sequences.catalogue import open_sequence, sequence_names

ORDER = ("09", "10", *(f"{number:02d}" for number in range(9)))  # the two that papers quote come first
ASSUMED_RATE = 8.0  # frames a second without the map: full-size images take 0.1 s of processor time each


class Mark(NamedTuple):
    """A published error: frames of the whole sequence, ATE RMSE in metres after 7-dof alignment, and whose it is."""

    frames: int
    ate_m: float
    system: str


MARKS = {
    "KITTI 00": Mark(4541, 4.48, "DA3-Streaming"),
    "KITTI 01": Mark(1101, 11.50, "DPV-SLAM"),
    "KITTI 02": Mark(4661, 11.30, "GigaSLAM"),
    "KITTI 03": Mark(801, 0.94, "ORB-SLAM2 without loops"),
    "KITTI 04": Mark(271, 0.68, "DPVO"),
    "KITTI 05": Mark(2761, 3.04, "DA3-Streaming, chunks of 60"),
    "KITTI 06": Mark(1101, 2.11, "GigaSLAM"),
    "KITTI 07": Mark(1101, 0.98, "DF-VO"),
    "KITTI 08": Mark(4071, 7.04, "GigaSLAM"),
    "KITTI 09": Mark(1591, 3.94, "GigaSLAM"),
    "KITTI 10": Mark(1201, 2.18, "GigaSLAM"),
}
MEASURED = (m.FRAMES, m.LENGTH, m.ATE_7, m.ATE_6, m.SCALE, m.R_REL, m.LOOPS, m.FALSE_LOOPS, m.RATE, m.MEMORY)


def present(kitti: Path, names: Sequence[str]) -> tuple[dict[str, int], list[str]]:
    """Frames of every sequence that can be measured, and lines on those that cannot.

    Raises:
        SequenceError: one of them is damaged, or there is no such root.
    """
    frames, left_out = {}, []
    there = sequence_names(kitti)
    absent = [name for name in names or ORDER if name not in there]
    if absent:
        left_out.append(f"not in {kitti}: {', '.join(absent)}")
    for name in (name for name in names or ORDER if name in there):
        sequence = open_sequence(kitti, name)
        if sequence.reference is None:
            left_out.append(f"{name}, which has no true poses ({kitti / 'poses' / name}.txt)")
        else:
            frames[name] = len(sequence)
    return frames, left_out


def time_to_go(jobs: Sequence[Job], frames: dict[str, int], at_a_time: int) -> str:
    """What was measured before, what is still to be run, and about how long that takes."""
    done = {job.place: job_result(job) for job in jobs if is_done(job)}
    rates = m.values(list(done.values()), m.RATE)
    left = [job for job in jobs if job.place not in done]
    count = sum(frames[job.drive.sequence] for job in left)
    rate = fmean(rates) if rates else ASSUMED_RATE
    source = "measured" if rates else "assumed"
    minutes = math.ceil(count / rate / at_a_time / 60)
    names = ", ".join(f"{job.drive.name} ({frames[job.drive.sequence]})" for job in left)
    return (
        f"{len(done)} of {len(jobs)} runs are done. "
        + f"To run: {names or 'none'}; {count} frames, about {minutes} min at {rate:.1f} frames / s ({source})"
    )


def tables(results: Sequence[JobResult]) -> str:
    """Our errors beside the smallest published one that is known here."""
    before, after = ({q.title: m.over_seeds(q) for q in each} for each in (MEASURED[:3], MEASURED[3:]))
    return f"""ATE is of the optimised trajectory, metres; the map is off, which changes no trajectory. *Published* is
the smallest ATE of a monocular system that is known here, 7-dof; it was not run here, and only whole sequences have it.
Those of GigaSLAM, DF-VO, DPVO, DPV-SLAM and ORB-SLAM2 are in table 1 of the GigaSLAM paper, which quotes the others'
papers; those of DA3-Streaming in its README.

{m.table({"sequence": m.drive, "weights": m.weights}, {**before, "published, 7-dof": _mark, **after}, results)}"""


def _mark(group: Sequence[JobResult]) -> str:
    mark = MARKS.get(group[0].job.drive.name)
    is_whole = mark and m.values(group, m.FRAMES)[:1] == [mark.frames]
    return f"{mark.ate_m:.2f} ({mark.system})" if mark and is_whole else DASH
