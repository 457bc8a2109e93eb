"""Cameras that are carried: public data sets, folders of images, simulated rooms; losses, waits and located frames."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any, Literal, get_args

from benchmarking.definitions import MetricDefinition, share
from benchmarking.metrics import FRAMES
from benchmarking.runs import BenchmarkSequence, simulated
from benchmarking.tracking import error_and_path, first_map, longest_wait, losses

from slam.sequences.catalogue import sequence_kinds
from slam.sequences.poses import poses_beside
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

ATE = MetricDefinition("ATE 7-dof (m)", lambda o: None if o.reason else error_and_path(o.job)[0], 3)
PATH = MetricDefinition("path (m)", lambda o: None if o.reason else error_and_path(o.job)[1], 1)
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
    """Everything that the options name; rooms are made in ``folder`` where they are missing.

    Raises:
        SystemExit: a root holds no sequence of its kind.
    """
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
