"""Accuracy and speed: sequences x configurations x seeds, as CSV files and as docs/benchmarks.md.

accuracy measures simulated worlds and KITTI sequences, full-size the same worlds and KITTI at the size of KITTI's
cameras, maps the errors of the map with one of its parts turned off at a time, handheld cameras that are carried: data
sets beside published marks, folders of images, simulated rooms.
Every run is a process and a folder of its own under --output. A successful one is not repeated as long as commit
and options stay the same, so that a killed benchmark can be resumed; a failed one is a row with its reason.
--jobs and --scheduler need Dask: pip install 'erfsfm-slam[cluster]'. A scheduler's workers need the same files at the
same paths. speed measures two checkouts in turn: time, memory and stages; nothing of it is kept.

Example: python tools/benchmark.py accuracy --kitti KITTI --jobs 2
"""

from __future__ import annotations

import argparse
import os
import shlex
import shutil
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

from benchmarking import handheld, page, speed
from benchmarking import runs as p
from benchmarking.metrics import rows
from shared.command import one_line_errors, parser_of

from erfsfm.common.files import write_atomically
from erfsfm.common.table import csv_of

Add = Callable[..., object]  # adds an option to a mode, as `add_argument` does
_BOTH = ("loop", "straight")
# options of paths, which the page calls by these names
_PATHS = ("report", "kitti", "data", *handheld.ROOTS, "output", "worlds_in", "against")


@dataclass(frozen=True)
class Mode:
    """What a mode measures, and the defaults of its options."""

    what: str
    configurations: dict[str, tuple[str, ...]]
    routes: tuple[str, ...]
    worlds: tuple[int, ...] = (610,)
    weights: tuple[str, ...] = ("default",)
    seeds: tuple[int, ...] = (0,)


MODES = {
    "accuracy": Mode(
        "errors of all trajectories", p.ACCURACY, _BOTH, (610, 611), ("default", "sim"), (0, 1, 2)
    ),
    "full-size": Mode(
        "the same at 1242x375, on worlds and on original images of KITTI",
        p.ACCURACY,
        _BOTH,
        (610, 611),
    ),
    "maps": Mode(
        "errors, size and cost of the map, with one of its parts turned off at a time",
        p.MAPS,
        ("loop",),
    ),
    "handheld": Mode("errors, losses and waits of cameras that are carried", p.ACCURACY, ()),
}


@one_line_errors()
def main(words: Sequence[str] | None = None) -> None:
    """Plan the runs, execute those that are missing, write tables."""
    words = sys.argv[1:] if words is None else words
    options = _parser().parse_args(words)
    command = shlex.join(["python", "tools/benchmark.py", *words])
    if options.mode == "speed":
        _compare_speed(options, command)
        return
    jobs = _jobs(options)
    if not jobs:
        raise SystemExit("nothing to measure: give --routes or a recording; see --help")
    results = p.measured(jobs, options.jobs, options.scheduler)
    table_of_runs = rows(results, handheld.DEFINITIONS if options.mode == "handheld" else ())
    write_atomically(options.output / f"{options.mode}.csv", csv_of(table_of_runs))
    text = page.section(
        options.mode, command, results, "several" if options.scheduler else str(options.jobs)
    )
    _write_section(options, text)
    print(text)
    if options.mode == "accuracy" and page.drawable(results):
        page.draw(results, options.report.parent / page.PICTURE)
    print(f"{options.report}: {len(results)} runs, {sum(bool(o.reason) for o in results)} failed")


def _write_section(options: argparse.Namespace, text: str) -> None:
    """Into the page, with names in place of the paths of one machine."""
    folders = [*getattr(options, "drives", ()), *getattr(options, "folders", ())]
    known = [(getattr(options, name, None), name.upper()) for name in _PATHS]
    for path, name in (
        *known,
        *((folder.parent, folder.parent.name) for folder in folders),
        (p.ROOT, "."),
    ):
        for written in (str(path.resolve()), str(path)) if path else ():
            text = text.replace(written, name)
    report: Path = options.report
    old = report.read_text(encoding="utf-8") if report.is_file() else ""
    write_atomically(report, page.with_section(old, text))


def _compare_speed(options: argparse.Namespace, command: str) -> None:
    """Write the section of two checkouts in turn."""
    drives = {}
    if options.kitti is not None:
        kitti = ["--dataset", str(options.kitti.resolve()), "--sequence", options.sequence]
        drives[f"KITTI {options.sequence}"] = kitti
        drives[f"KITTI {options.sequence}, no map"] = [*kitti, "--set", "mapping.enabled=false"]
    for folder in options.folders:
        drives[folder.resolve().parent.name] = ["--dataset", str(folder.resolve())]
    if options.frames:
        (grid,) = p.worlds((options.output / "worlds").resolve(), ["grid"], [610], options.frames)
        p.make(grid)
        drives[f"grid 610, {options.frames} frames"] = ["--dataset", str(grid.root)]
    runs = (options.output / "speed").resolve()
    shutil.rmtree(runs, ignore_errors=True)
    runs.mkdir(parents=True)
    checkouts = zip(("before", "after"), (options.against.resolve(), p.ROOT))
    named = {f"{when} ({p.revision(checkout)})": checkout for when, checkout in checkouts}
    text = speed.tables(speed.in_turn(named, drives, options.pairs, runs))
    _write_section(options, page.speed_section(command, text))
    print(text)


def _jobs(options: argparse.Namespace) -> list[p.Job]:
    folder = options.output.resolve() / options.mode / p.revision()
    simulated = (options.worlds_in or options.output / "worlds").resolve()
    of_worlds = {"maps": ("--depth",), "full-size": ("--width", "1242", "--height", "375")}.get(
        options.mode, ()
    )
    if options.mode == "handheld":
        drives = handheld.drives(options, simulated)
    else:
        drives = p.worlds(
            simulated, options.routes, options.worlds, options.frames, options.conditions, of_worlds
        )
    drives += p.raw_drives(getattr(options, "drives", ()))
    if getattr(options, "kitti", None) is not None:
        drives += p.recordings(options.kitti.resolve(), options.sequences, options.excerpt)
    if getattr(options, "data", None) is not None:
        for root in p.ORIGINALS:
            drives += p.recordings(options.data.resolve() / root, (), None)
    configurations = MODES[options.mode].configurations
    parts = getattr(options, "parts", None)
    if parts is not None:
        configurations = {name: configurations[name] for name in (p.EVERYTHING, *parts)}
    return p.plan(
        folder, drives, configurations, options.weights, options.seeds, options.set, options.device
    )


def _parser() -> argparse.ArgumentParser:
    parser = parser_of(__doc__)
    modes = parser.add_subparsers(dest="mode", required=True, metavar="|".join([*MODES, "speed"]))
    for name, mode in MODES.items():
        add = _options_of(modes.add_parser, name, mode.what)
        _add_recordings(add, name)
        if name == "handheld":
            handheld.add_options(add)
        else:
            _add_worlds(add, mode)
        _add_runs(add, mode)
        if name in ("accuracy", "maps"):
            add("--excerpt", metavar="A:B", help="frames of the sequences of --kitti, half-open")
        if name == "maps":
            _add_parts(add, mode)
        add("--jobs", type=int, default=1, help="runs at a time; more than one needs Dask")
        add("--scheduler", metavar="ADDRESS", help="of a Dask cluster in place of local processes")
    what = "time, memory and stages of two checkouts in turn"
    _add_checkouts(_options_of(modes.add_parser, "speed", what))
    return parser


def _options_of(add_parser: Callable[..., argparse.ArgumentParser], name: str, what: str) -> Add:
    """The function that adds an option to a new mode; what every mode writes is there already."""
    show = argparse.ArgumentDefaultsHelpFormatter
    add = add_parser(name, help=what, description=what, formatter_class=show).add_argument
    add(
        "--output",
        type=Path,
        default=Path("runs/benchmark"),
        help="keeps runs, worlds and CSV files",
    )
    add(
        "--report",
        type=Path,
        default=Path("docs/benchmarks.md"),
        help="the page whose section is written",
    )
    return add


def _add_recordings(add: Add, mode: str) -> None:
    if mode == "full-size":
        data = os.environ.get("ERFSFM_DATA")
        add(
            "--data",
            type=Path,
            default=data and Path(data),
            metavar="FOLDER",
            help="recordings; $ERFSFM_DATA",
        )
    elif mode != "handheld":
        add("--kitti", type=Path, metavar="ROOT", help="a KITTI odometry root to measure")
        add(
            "--sequences",
            nargs="+",
            default=(),
            metavar="NAME",
            help="of that root; all of them without it",
        )


def _add_worlds(add: Add, mode: Mode) -> None:
    add("--routes", nargs="*", default=mode.routes, help="of simulated worlds")
    add("--worlds", nargs="+", type=int, default=mode.worlds, help="their seeds")
    add("--frames", type=int, default=300, help="their length")
    add(
        "--conditions",
        nargs="+",
        choices=get_args(p.Condition),
        default=["clean"],
        help="hazards: all at once",
    )


def _add_runs(add: Add, mode: Mode) -> None:
    add(
        "--worlds-in",
        type=Path,
        metavar="FOLDER",
        help="where they are or will be; OUTPUT/worlds without it",
    )
    add("--weights", nargs="+", default=mode.weights, help="names or folders")
    add("--seeds", nargs="+", type=int, default=mode.seeds, help="of the RANSAC draws")
    add("--set", nargs="+", default=(), metavar="KEY=VALUE", help="changes to every configuration")
    add(
        "--device",
        choices=("auto", "cpu", "cuda"),
        default="cpu",
        help="where the networks compute",
    )


def _add_parts(add: Add, mode: Mode) -> None:
    add("--drives", nargs="+", type=Path, default=(), metavar="FOLDER", help="KITTI raw drives")
    parts = list(mode.configurations)
    parts.remove(p.EVERYTHING)
    add(
        "--parts",
        nargs="*",
        choices=parts,
        metavar="PART",
        help=f"to turn off: {', '.join(parts)}; else all",
    )


def _add_checkouts(add: Add) -> None:
    add(
        "--against",
        type=Path,
        required=True,
        metavar="CHECKOUT",
        help="the other checkout, run before this one",
    )
    add(
        "--kitti",
        type=Path,
        metavar="ROOT",
        help="a KITTI odometry root, run with its map and without",
    )
    add("--sequence", default="05", help="of that root")
    add("--folders", nargs="*", type=Path, default=(), metavar="FOLDER", help="folders of images")
    add("--frames", type=int, default=2000, help="of a simulated grid; 0 leaves it out")
    add("--pairs", type=int, default=3, help="runs of each drive by each checkout")


if __name__ == "__main__":
    main()
