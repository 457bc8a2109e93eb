"""Accuracy and speed: sequences x configurations x seeds, as CSV files and as docs/benchmarks.md.

accuracy measures simulated worlds and KITTI sequences, full-size the same worlds and KITTI at the size of KITTI's
cameras, ablation turns off one part at a time, maps the errors of the map with one of its parts turned off at a time,
handheld cameras that are carried: data sets beside published marks, folders of images, simulated rooms.
Every run is a process and a folder of its own under --output. A successful one is not repeated as long as commit
and options stay the same, so that a killed benchmark can be resumed; a failed one is a row with its reason.
--jobs and --scheduler need Dask: pip install 'erfsfm-slam[cluster]'. A scheduler's workers need the same files at the
same paths. kitti runs whole sequences of KITTI odometry, 09 and 10 first, and says first how long that will take. speed
measures two checkouts in turn: time, memory and stages; nothing of it is kept.

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
from typing import Literal, get_args

from benchmarking import handheld, kitti, page, pairs
from benchmarking import plan as p
from benchmarking.metrics import rows
from benchmarking.work import ROOT, measured, revision, simulate, workers
from shared.command import one_line_errors, parser_of

from erfsfm.common.table import csv_of
from slam.runtime.storage.files import write_atomically


@dataclass(frozen=True)
class Mode:
    """What a mode measures, and the defaults of its options."""

    what: str
    configurations: tuple[p.Configuration, ...]
    routes: tuple[str, ...]
    worlds: tuple[int, ...] = (610,)
    weights: tuple[str, ...] = ("default",)
    seeds: tuple[int, ...] = (0,)


_BOTH = ("loop", "straight")
_ROOTS = ("kitti", "data", *handheld.ROOTS)  # options of data sets, which the page calls by these names
# options that a section of the page does not state, or states by other names
_UNSAID = {"mode", "output", "report", "jobs", "scheduler", "worlds_in", "drives", "folders", *_ROOTS}
MODES = {
    "accuracy": Mode("errors of all trajectories", p.ACCURACY, _BOTH, (610, 611), ("default", "sim"), (0, 1, 2)),
    "full-size": Mode("the same at 1242x375, on worlds and on original images of KITTI", p.ACCURACY, _BOTH, (610, 611)),
    "ablation": Mode("the same with one part turned off at a time", p.ABLATION, _BOTH, weights=("default", "sim")),
    "maps": Mode("errors, size and cost of the map, with one of its parts turned off at a time", p.MAPS, ("loop",)),
    "kitti": Mode("whole sequences of KITTI odometry, beside published errors", p.WHOLE, (), weights=("sim",)),
    "handheld": Mode("errors, losses and waits of cameras that are carried", p.ACCURACY, ()),
}


@one_line_errors()
def main(words: Sequence[str] | None = None) -> None:
    """Plan the runs, execute those that are missing, write tables."""
    options = _parser().parse_args(words)
    if options.mode == "speed":
        _compare_speed(options)
        return
    jobs = _whole_sequences(options) if options.mode == "kitti" else _jobs(options)
    if not jobs:
        raise SystemExit("nothing to measure: give --routes or a recording; see --help")
    with workers(options.jobs, options.scheduler) as spread:
        results = measured(jobs, spread)
    table_of_runs = rows(results, handheld.DEFINITIONS if options.mode == "handheld" else ())
    content = csv_of(table_of_runs).encode()
    write_atomically(options.output / f"{options.mode}.csv", lambda file: file.write_bytes(content))
    drives = [(path, "DRIVE") for name in ("drives", "folders") for path in getattr(options, name, ())]
    text = page.section(options.mode, _command(options), results, "several" if options.scheduler else str(options.jobs))
    roots = [(getattr(options, name, None), name.upper()) for name in _ROOTS]
    known = (options.output, "OUTPUT"), (getattr(options, "worlds_in", None), "WORLDS"), *roots, (ROOT, "."), *drives
    for path, name in known:
        text = text.replace(str(path.resolve()), name) if path else text
    _write_section(options.report, text)
    if options.mode in ("accuracy", "full-size"):
        print(page.summary_table(results))
    if options.mode == "kitti":
        print(kitti.tables(results))
    if options.mode == "handheld":
        print(page.handheld_summary(results))
    if options.mode == "accuracy" and page.drawable(results):
        page.draw(results, options.report.parent / page.PICTURE)
    print(f"{options.report}: {len(results)} runs, {sum(bool(o.reason) for o in results)} failed")


def _write_section(report: Path, text: str) -> None:
    old = report.read_text(encoding="utf-8") if report.is_file() else ""
    write_atomically(report, lambda file: file.write_text(page.with_section(old, text), encoding="utf-8"))


def _compare_speed(options: argparse.Namespace) -> None:
    """Write the section of two checkouts in turn."""
    drives, command = [], ["python", "tools/benchmark.py", "speed", "--against", "CHECKOUT"]
    if options.kitti is not None:
        drive = "--dataset", str(options.kitti.resolve()), "--sequence", options.sequence
        drives.append(pairs.Drive(f"KITTI {options.sequence}", drive))
        drives.append(pairs.Drive(f"KITTI {options.sequence}, no map", (*drive, "--set", "mapping.enabled=false")))
        command += ["--kitti", "KITTI", "--sequence", options.sequence]
    for folder in options.folders:
        drives.append(pairs.Drive(folder.resolve().parent.name, ("--dataset", str(folder.resolve()))))
        command += ["--folders", f"DATA/{folder.resolve().parent.name}/{folder.name}"]
    if options.frames:
        (grid,) = p.worlds((options.output / "worlds").resolve(), ["grid"], [610], options.frames)
        simulate(grid)
        drives.append(pairs.Drive(f"grid 610, {options.frames} frames", ("--dataset", str(grid.root))))
    command += ["--frames", str(options.frames), "--pairs", str(options.pairs)]
    checkouts = options.against.resolve(), ROOT
    runs = (options.output / "speed").resolve()
    shutil.rmtree(runs, ignore_errors=True)
    runs.mkdir(parents=True)
    costs = pairs.in_turn(checkouts, drives, options.pairs, runs)
    text = pairs.tables([revision(checkout) for checkout in checkouts], drives, costs)
    _write_section(options.report, page.speed_section(shlex.join(command), text))
    print(text)


def _jobs(options: argparse.Namespace) -> list[p.Job]:
    folder = options.output.resolve() / options.mode
    simulated = (options.worlds_in or options.output / "worlds").resolve()
    truth: tuple[Literal["depth"], ...] = ("depth",) if options.mode == "maps" else ()
    size = p.FULL_SIZE if options.mode == "full-size" else None
    if options.mode == "handheld":
        drives = handheld.drives(options, simulated)
    else:
        drives = p.worlds(simulated, options.routes, options.worlds, options.frames, options.conditions, truth, size)
    drives += p.raw_drives(getattr(options, "drives", ()))
    if getattr(options, "kitti", None) is not None:
        drives += p.recordings(options.kitti.resolve(), options.sequences, options.excerpt)
    if getattr(options, "data", None) is not None:
        drives += p.original_recordings(options.data.resolve())
    configurations = MODES[options.mode].configurations
    parts = getattr(options, "parts", None)
    if parts is not None:
        configurations = tuple(c for c in configurations if c is p.EVERYTHING or c.name in parts)
    rest = options.weights, options.seeds, options.set, options.device
    return p.plan(folder, drives, configurations, *rest)


def _whole_sequences(options: argparse.Namespace) -> list[p.Job]:
    """The sequences that are there; says which are not, and how long the others take."""
    root = options.kitti.resolve()
    frames, absent = kitti.present(root, options.sequences)
    for line in absent:
        print(f"left out: {line}", file=sys.stderr)
    if not frames:
        raise SystemExit(f"nothing to measure: {root} has none of these with true poses; give another --kitti")
    rest = options.weights, options.seeds, options.set, options.device
    folder = options.output.resolve() / options.mode
    jobs = p.plan(folder, p.recordings(root, list(frames), None), MODES["kitti"].configurations, *rest)
    print(kitti.time_to_go(jobs, frames, options.jobs), file=sys.stderr)
    return jobs


def _command(options: argparse.Namespace) -> str:
    """The command with its defaults, without the paths and hosts of one machine."""
    words = ["python", "tools/benchmark.py", options.mode]
    for name in _ROOTS:
        words += [f"--{name.replace('_', '-')}", name.upper()] if getattr(options, name, None) else []
    drives = getattr(options, "drives", ())
    names = [f"KITTI_RAW/{drive.resolve().parent.name}/{drive.name}" for drive in drives]
    words += ["--drives", *names] if names else []
    folders = [f"DATA/{folder.resolve().parent.name}/{folder.name}" for folder in getattr(options, "folders", ())]
    words += ["--folders", *folders] if folders else []
    for name, value in vars(options).items():
        if name not in _UNSAID and value not in (None, ()):
            words += [f"--{name}", *map(str, value if isinstance(value, list | tuple) else [value])]
    return shlex.join(words)


def _parser() -> argparse.ArgumentParser:
    parser = parser_of(__doc__)
    modes = parser.add_subparsers(dest="mode", required=True, metavar="|".join([*MODES, "speed"]))
    for name, mode in MODES.items():
        add = modes.add_parser(
            name, help=mode.what, description=mode.what, formatter_class=argparse.ArgumentDefaultsHelpFormatter
        ).add_argument
        if name == "full-size":
            data = os.environ.get("ERFSFM_DATA")
            add("--data", type=Path, default=data and Path(data), metavar="FOLDER", help="recordings; $ERFSFM_DATA")
        elif name != "handheld":
            add("--kitti", type=Path, metavar="ROOT", required=name == "kitti", help="a KITTI odometry root to measure")
            add("--sequences", nargs="+", default=(), metavar="NAME", help="of that root; all of them without it")
        if name == "handheld":
            handheld.add_options(add)
            add("--worlds-in", type=Path, metavar="FOLDER", help="where they are or will be; OUTPUT/worlds without it")
        elif name != "kitti":
            _add_worlds(add, mode)
        add("--weights", nargs="+", default=mode.weights, help="names or folders")
        add("--seeds", nargs="+", type=int, default=mode.seeds, help="of the RANSAC draws")
        add("--set", nargs="+", default=(), metavar="KEY=VALUE", help="changes to every configuration")
        add("--device", choices=("auto", "cpu", "cuda"), default="cpu", help="where the networks compute")
        add("--output", type=Path, default=Path("runs/benchmark"), help="keeps runs, worlds and CSV files")
        add("--report", type=Path, default=Path("docs/benchmarks.md"), help="the page whose section is written")
        if name in ("accuracy", "ablation", "maps"):
            add("--excerpt", metavar="A:B", help="frames of the sequences of --kitti, half-open")
        if name in ("maps", "ablation"):
            add("--drives", nargs="+", type=Path, default=(), metavar="FOLDER", help="KITTI raw drives")
            parts = [each.name for each in mode.configurations if each is not p.EVERYTHING]
            add("--parts", nargs="*", choices=parts, metavar="PART", help=f"to turn off: {', '.join(parts)}; else all")
        add("--jobs", type=int, default=1, help="runs at a time; more than one needs Dask")
        add("--scheduler", metavar="ADDRESS", help="of a Dask cluster in place of local processes")
    what = "time, memory and stages of two checkouts in turn"
    add = modes.add_parser(
        "speed", help=what, description=what, formatter_class=argparse.ArgumentDefaultsHelpFormatter
    ).add_argument
    add("--against", type=Path, required=True, metavar="CHECKOUT", help="the other checkout, run before this one")
    add("--kitti", type=Path, metavar="ROOT", help="a KITTI odometry root, run with its map and without")
    add("--sequence", default="05", help="of that root")
    add("--folders", nargs="*", type=Path, default=(), metavar="FOLDER", help="folders of images")
    add("--frames", type=int, default=2000, help="of a simulated grid; 0 leaves it out")
    add("--pairs", type=int, default=3, help="runs of each drive by each checkout")
    add("--output", type=Path, default=Path("runs/benchmark"), help="keeps the last runs and the world")
    add("--report", type=Path, default=Path("docs/benchmarks.md"), help="the page whose section is written")
    return parser


def _add_worlds(add: Callable[..., object], mode: Mode) -> None:
    """The options of simulated worlds."""
    add("--routes", nargs="*", default=mode.routes, help="of simulated worlds")
    add("--worlds", nargs="+", type=int, default=mode.worlds, help="their seeds")
    add("--frames", type=int, default=300, help="their length")
    add("--conditions", nargs="+", choices=get_args(p.Condition), default=["clean"], help="hazards: all at once")
    add("--worlds-in", type=Path, metavar="FOLDER", help="where they are or will be; OUTPUT/worlds without it")


if __name__ == "__main__":
    main()
