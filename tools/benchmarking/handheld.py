"""Cameras that are carried: public data sets, folders of images, simulated rooms; losses, waits and located frames."""

from __future__ import annotations

import functools
from argparse import Namespace
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from benchmarking.metrics import FRAMES, MetricDefinition, share
from benchmarking.runs import BenchmarkSequence, Job, JobResult, simulated

from slam.evaluation.trajectory import trajectory_metrics
from slam.formats.trajectory import Trajectory
from slam.results.folder import RunFolder
from slam.sequences.catalogue import open_sequence, sequence_kinds
from slam.sequences.poses import known_poses, poses_beside
from slam.sequences.recording import RecordedSequence
from slam.simulation.options import Motion, RoomHazard

RoomCondition = Literal["clean"] | RoomHazard
_CONDITIONS: tuple[RoomCondition, ...] = ("clean", "people", "exposure", "blur", "rolling-shutter")
SEEDS = tuple(range(730, 740))  # used for nothing else
SIZE = 640, 480  # pixels of a room's images
ROOTS = {
    "tum": "TUM RGB-D",
    "seven_scenes": "7-Scenes",
    "euroc": "EuRoC",
}  # options, and the kinds that they name
MARKS = {
    "TUM RGB-D": "fr1: 0.030 m on average (MASt3R-SLAM, calibrated, on a GPU); ORB-SLAM3 loses five of nine",
    "7-Scenes": "seq-01: 0.049 m on average; the reference itself is 0.014 to 0.15 m off COLMAP's",
    "EuRoC": "MH01 to MH05: 0.021 to 0.100 m (ORB-SLAM3)",
}


def add_options(add: Callable[..., Any]) -> None:
    """The options that say what is measured."""
    for option, kind in ROOTS.items():
        add(
            f"--{option.replace('_', '-')}",
            type=Path,
            metavar="ROOT",
            help=f"{kind}: all of its sequences",
        )
    add(
        "--folders",
        nargs="+",
        type=Path,
        default=(),
        metavar="FOLDER",
        help="of images; truth: poses*.txt beside it",
    )
    add(
        "--rooms",
        nargs="*",
        type=int,
        metavar="SEED",
        help="simulated rooms; without numbers 730 to 739",
    )
    add(
        "--motions",
        nargs="+",
        choices=get_args(Motion),
        default=("walk", "phone"),
        help="through each of the rooms",
    )
    add("--rates", nargs="+", type=int, default=(10, 30), help="frames a second")
    conditions = "clean", *get_args(RoomHazard)
    add("--hazards", nargs="+", choices=conditions, default=_CONDITIONS, help="one at a time")
    add("--seconds", type=int, default=30, help="length of a walk")


def drives(options: Namespace, folder: Path) -> list[BenchmarkSequence]:
    """Everything that the options name; rooms are made in ``folder`` where they are missing."""
    found = []
    for option, kind in ROOTS.items():
        root = getattr(options, option)
        if root is not None:
            names = [name for name, its in sequence_kinds(root).items() if its == kind]
            if not names:
                raise SystemExit(
                    f"no sequence of {kind} in {root}: give the folder that holds them"
                )
            found += [
                BenchmarkSequence(f"{kind} {name}", root.resolve(), name, kind=kind)
                for name in names
            ]
    for path in options.folders:
        root = path.resolve()
        name = root.parent.name
        found.append(BenchmarkSequence(name, root, "", kind=name, truth=poses_beside(root)))
    seeds = () if options.rooms is None else options.rooms or SEEDS
    width, height = SIZE
    for condition, rate, motion, seed in product(
        options.hazards, options.rates, options.motions, seeds
    ):
        words = [
            "--route",
            "rooms",
            "--seed",
            str(seed),
            "--frames",
            str(options.seconds * rate),
            "--motion",
            motion,
        ]
        words += ["--rate", str(rate), "--width", str(width), "--height", str(height)]
        name, hazards = (
            f"rooms {seed}, {motion}, {rate} Hz",
            "" if condition == "clean" else condition,
        )
        found.append(simulated(folder, name, f"rooms, {rate} Hz", words, condition, hazards))
    return found


@functools.cache
def _error_and_path(job: Job) -> tuple[float | None, float | None]:
    """7-dof ATE of the optimised trajectory, and the path, by those frames whose true pose is known, metres."""
    drive = job.drive
    sequence = open_sequence(drive.root, drive.sequence or None, truth=drive.truth)
    poses = sequence.T_any_camera if isinstance(sequence, RecordedSequence) else None
    known = np.zeros(0, np.intp) if poses is None else np.flatnonzero(known_poses(poses))
    estimate = RunFolder(job.place).trajectory("optimised")
    if poses is None or estimate is None or not len(known):
        return None, None
    truth = Trajectory(sequence.stamps[known], poses[known]).rebased()
    ate: float | None = trajectory_metrics(
        estimate.select(known).rebased(), truth
    ).align.dof7.ate_rmse_m
    return ate, truth.length_m


def losses(o: JobResult) -> int | None:
    """How often the camera was lost."""
    events = o.metrics.tracking.events
    return None if events is None else sum(each.event == "lost" for each in events)


def first_map(o: JobResult) -> int | None:
    """Number of frames before the first map."""
    events = o.metrics.tracking.events or ()
    return next((each.frame for each in events if each.event == "map begun"), None)


def longest_wait(o: JobResult) -> int | None:
    """Most frames from a loss until the camera was found again, or a new map began, or the recording ended."""
    events, frames = o.metrics.tracking.events, o.metrics.sequence.frames
    if events is None or frames is None:
        return None
    lost = [each.frame for each in events if each.event == "lost"]
    found = [each.frame for each in events if each.event in ("map begun", "relocalised")]
    waits = [
        min((frame for frame in found if frame > start), default=frames) - start for start in lost
    ]
    return max(waits, default=None)


ATE = MetricDefinition(
    "ATE 7-dof (m)", lambda o: None if o.reason else _error_and_path(o.job)[0], 3
)
PATH = MetricDefinition("path (m)", lambda o: None if o.reason else _error_and_path(o.job)[1], 1)
PERCENT = share("7-dof, % of path", ATE, PATH, 100.0)
LOSSES = MetricDefinition("losses", losses)
FIRST_MAP = MetricDefinition("frames before the first map", first_map)
NEW_MAP = MetricDefinition("most frames before a new map", longest_wait)
LOCATED = share(
    "share of frames located",
    MetricDefinition("located", "tracking.located_frames"),
    FRAMES,
    1.0,
    3,
)
DEFINITIONS = (ATE, PATH, PERCENT, LOSSES, FIRST_MAP, NEW_MAP, LOCATED)
