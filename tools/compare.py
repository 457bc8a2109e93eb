"""Our system and ORB-SLAM3 on the same recordings, side by side: errors, processor time, memory and map, as a page.

ORB-SLAM3 runs through the wheel pyorbslam3 in an environment of its own: it is no dependency of this project. Both get
the same images: ORB-SLAM3 as grey pixels, decoded and undistorted beforehand. It needs a vocabulary of ORB descriptors
in DBoW2's text form, such as ORBvoc.txt. Runs that ended well are kept under --output.

Example: python tools/compare.py --data DATA --orb-python ORB_ENV/bin/python --vocabulary ORBvoc.txt
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from textwrap import fill
from typing import Any

import cv2
from benchmarking import metrics as m
from benchmarking.page import notes
from benchmarking.plan import QUIET, WHOLE, BenchmarkSequence, Configuration, plan, slug
from benchmarking.work import JobResult, job_result, perform, revision
from shared.command import one_line_errors, parser_of

from erfsfm.common.processes import why_ended
from erfsfm.common.table import DASH, Table
from slam.evaluation.trajectory import trajectory_metrics
from slam.formats.trajectory import Trajectory, associate, read_trajectory
from slam.results.folder import RunFolder
from slam.results.tables import written
from slam.runtime.storage.files import write_atomically
from slam.sequences.catalogue import open_sequence

WITH_MAP = Configuration("map", QUIET)
PEER = Path(__file__).parent / "benchmarking" / "orbslam3.py"
DRIVING, CARRIED = 2000, 1000  # corners that ORB-SLAM3's own examples ask for
RAW_DRIVE = "kitti_raw/2011_09_26/2011_09_26_drive_0013_sync"


@dataclass(frozen=True)
class Compared:
    """A recording below the folder of all recordings."""

    name: str
    path: str
    features: int
    sequence: str = ""
    truth: str = ""

    def drive(self, data: Path) -> BenchmarkSequence:
        """As the benchmark runs it."""
        truth = data / self.truth if self.truth else None
        return BenchmarkSequence(self.name, data / self.path, self.sequence, truth=truth)


RECORDINGS = (
    *(Compared(f"KITTI {name}", "kitti_odometry", DRIVING, name) for name in ("00", "02", "05")),
    Compared("drive 0013", RAW_DRIVE, DRIVING),
    Compared("kitchen", "handheld_kitchen/images", CARRIED, truth="handheld_kitchen/poses.kitti.txt"),
    Compared("euroc_micro", "euroc_micro", CARRIED),
)


@dataclass(frozen=True)
class PeerRun:
    """One run of ORB-SLAM3: its trajectory by stamps, what it took, or why it failed."""

    trajectory: Trajectory | None
    record: dict[str, Any]
    reason: str = ""


@dataclass(frozen=True)
class Pair:
    """Both systems on one recording."""

    name: str
    with_map: JobResult
    without_map: JobResult
    peer: PeerRun


@one_line_errors()
def main(words: Sequence[str] | None = None) -> None:
    """Run what is missing, and write the page."""
    options = _parser().parse_args(words)
    if options.data is None:
        raise SystemExit("the folder of recordings is wanted: give --data, or set ERFSFM_DATA")
    for what, path in (("Python", options.orb_python), ("vocabulary", options.vocabulary)):
        if not path.is_file():
            raise SystemExit(f"no {what} of ORB-SLAM3 at {path}: give the file")
    data = options.data.resolve()
    chosen = [each for each in RECORDINGS if options.only is None or each.name in options.only]
    there = [each for each in chosen if _is_there(each, data)]
    absent = [each.name for each in chosen if each not in there]
    if absent:
        print(f"left out, not in {data}: {', '.join(absent)}", file=sys.stderr)
    if not there:
        raise SystemExit(f"nothing to compare in {data}: it holds none of {', '.join(each.name for each in chosen)}")
    pairs = []
    for each in there:
        pairs += _pairs(each, data, options)
        print(f"{len(pairs) // options.runs} of {len(there)} recordings: {each.name}", file=sys.stderr)
    text = page(pairs, _command(options), revision(), options.remarks)
    write_atomically(options.report, lambda file: file.write_text(text, encoding="utf-8"))
    print(text)


def _is_there(each: Compared, data: Path) -> bool:
    path = data / each.path
    return (path / "sequences" / each.sequence if each.sequence else path).is_dir()


def _pairs(each: Compared, data: Path, options: argparse.Namespace) -> list[Pair]:
    """Our runs beside every run of ORB-SLAM3."""
    drive, folder = each.drive(data), options.output.resolve()
    with_map, without = plan(folder, [drive], (WITH_MAP, *WHOLE), [options.weights], [0])
    for job in (with_map, without):
        perform(job)
    ours = job_result(with_map), job_result(without)
    places = (folder / f"orbslam3-{slug(each.name)}-{number}" for number in range(options.runs))
    return [Pair(each.name, *ours, _peer_run(each, drive, place, options)) for place in places]


def _peer_run(each: Compared, drive: BenchmarkSequence, folder: Path, options: argparse.Namespace) -> PeerRun:
    """Run ORB-SLAM3 once; a run that ended well is kept as long as its vocabulary and options stay the same."""
    digest = hashlib.sha256(options.vocabulary.read_bytes() + PEER.read_bytes()).hexdigest()
    identity = [str(drive.root), drive.sequence, each.features, options.pace, digest]
    kept = folder / "identity.json"
    if not (kept.is_file() and json.loads(kept.read_text()) == identity):
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        _write_recording(drive, each.features, folder)
        words = [str(options.orb_python.absolute()), str(PEER), str(folder)]
        words += [str(options.vocabulary.resolve()), str(options.pace)]
        environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
        finished = subprocess.run(words, capture_output=True, text=True, check=False, env=environment)
        (folder / "frames.raw").unlink()
        reason = why_ended(finished.returncode, finished.stderr)
        if reason:
            return PeerRun(None, {}, reason)
        kept.write_text(json.dumps(identity))
    record = json.loads((folder / "record.json").read_text())
    trajectory = folder / "trajectory.tum"
    return PeerRun(read_trajectory(trajectory, "tum") if trajectory.is_file() else None, record)


def _write_recording(drive: BenchmarkSequence, features: int, folder: Path) -> None:
    """Grey images, camera and stamps, as the script of the other environment reads them."""
    sequence = open_sequence(drive.root, drive.sequence or None)
    camera, stamps = sequence.intrinsics, sequence.stamps.tolist()
    with (folder / "frames.raw").open("wb") as file:
        for index in range(len(sequence)):
            file.write(cv2.cvtColor(sequence.frame(index).image, cv2.COLOR_RGB2GRAY).tobytes())
    recording = {key: getattr(camera, key) for key in ("width", "height", "fx", "fy", "cx", "cy")}
    rate = max(1, round((len(stamps) - 1) / (stamps[-1] - stamps[0])))
    recording |= {"stamps": stamps, "fps": rate, "features": features}
    (folder / "recording.json").write_text(json.dumps(recording))


def page(pairs: Sequence[Pair], command: str, commit: str, remarks: Sequence[str] = ()) -> str:
    """The page of all recordings."""
    accuracy = _table(_ACCURACY, pairs, 8)
    first = list({pair.name: pair for pair in reversed(pairs)}.values())[::-1]
    cost = _table(_COST, first, 9)
    failed = "".join(f"\n- ORB-SLAM3 failed on {p.name}: {p.peer.reason}" for p in pairs if p.peer.reason)
    without, with_map = [p.without_map for p in first], [p.with_map for p in first]
    return _PAGE.format(
        command=command,
        commit=commit or "unknown",
        weights=with_map[0].job.weights,
        remarks="".join(f"\n- {_wrapped(remark)}" for remark in remarks),
        accuracy=accuracy + notes(without, (m.LENGTH,)),
        cost=cost + notes([o for o in with_map if not o.reason], (m.TRIANGLES,)) + failed,
    )


def _table(columns: Mapping[str, Callable[[Pair], str]], pairs: Sequence[Pair], numbers: int) -> str:
    rows = [[cell(pair) for cell in columns.values()] for pair in pairs]
    return Table(list(columns), rows, names=len(columns) - numbers).markdown()


def _wrapped(text: str) -> str:
    return fill(text, 118, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)


def _ate(estimate: Trajectory | None, reference: Trajectory | None, among: Trajectory | None = None) -> str:
    """7-dof ATE of the frames that have a true pose, and a pose in ``among`` if that is given."""
    if estimate is None or reference is None:
        return DASH
    if among is not None:
        estimate, _ = associate(estimate, among)
    return written(trajectory_metrics(*associate(estimate, reference)).align.dof7.ate_rmse_m, 3)


def _ours(pair: Pair, name: str = "optimised") -> Trajectory | None:
    result = pair.without_map
    return None if result.reason else RunFolder.open(result.job.place / "run").trajectory(name)


def _of(definition: m.MetricDefinition, of: Callable[[Pair], JobResult]) -> Callable[[Pair], str]:
    return lambda pair: m.average(definition)([of(pair)])


def _metric(pair: Pair) -> str:
    """6-dof ATE where lengths are metres without the truth."""
    result = pair.without_map
    if result.reason or not result.metrics.is_metric:
        return DASH
    return written(result.metrics.trajectories.optimised.align.dof6.ate_rmse_m, 3)


def _peer_cpu(pair: Pair) -> str:
    frames = pair.without_map.metrics.sequence.frames
    seconds = pair.peer.record.get("cpu_s")
    return f"{1e3 * seconds / frames:.1f}" if seconds and frames else DASH


def _peer_number(key: str) -> Callable[[Pair], str]:
    return lambda pair: f"{pair.peer.record[key]:.0f}" if key in pair.peer.record else DASH


_with, _without = attrgetter("with_map"), attrgetter("without_map")
_ACCURACY: dict[str, Callable[[Pair], str]] = {
    "recording": lambda pair: pair.name,
    "frames": _of(m.FRAMES, _without),
    "path (m)": _of(m.LENGTH, _without),
    "poses, ours": lambda pair: str(len(_ours(pair) or ())),
    "poses, ORB-SLAM3": lambda pair: str(len(pair.peer.trajectory or ())),
    "ATE, ours": lambda pair: _ate(_ours(pair), _ours(pair, "reference"), pair.peer.trajectory),
    "ATE, ORB-SLAM3": lambda pair: _ate(pair.peer.trajectory, _ours(pair, "reference")),
    "all frames, ours": lambda pair: _ate(_ours(pair), _ours(pair, "reference")),
    "all frames, 6-dof": _metric,
}
_COST: dict[str, Callable[[Pair], str]] = {
    "recording": lambda pair: pair.name,
    "CPU ms / frame, ours": _of(m.CPU, _without),
    "with the map, ours": _of(m.CPU, _with),
    "CPU, ORB-SLAM3": _peer_cpu,
    "peak RSS (MiB), ours": _of(m.MEMORY, _without),
    "RSS with the map, ours": _of(m.MEMORY, _with),
    "RSS, ORB-SLAM3": _peer_number("peak_rss_mb"),
    "triangles, ours": _of(m.TRIANGLES, _with),
    "keyframes, ORB-SLAM3": _peer_number("keyframes"),
    "points in a frame, ORB-SLAM3": _peer_number("points"),
}
_PAGE = """# Comparison with ORB-SLAM3

    {command}

writes this page. Ours is commit {commit} with the weights `{weights}`. ORB-SLAM3 is the wheel pyorbslam3 0.1.1,
monocular, with the thresholds of its own examples and as many corners. It runs in an environment of its own; it is
under the GPL and no dependency of this project.

- Ours ran **once** on each recording: a seed gives the same bytes. Every row is a run of ORB-SLAM3, which is not the
  same twice, because its threads race.
- ORB-SLAM3 drops keyframes while its mapping is late. `--pace` is the speed of its images over that of the recording:
  a slow one gives its mapping time on a busy machine. The mapping then does more, and its processor time grows.
- Its images were decoded and undistorted beforehand, which its times leave out.{remarks}

## Accuracy

ATE RMSE in metres, after 7-dof alignment, over the frames that both systems give a pose. Ours gives every frame one;
ORB-SLAM3 has none before its map begins, or where it is lost. *6-dof* fits no scale: our lengths are metres there, by
the height of the camera alone. A monocular ORB-SLAM3 has no metric scale. 0 poses: it began no map.

{accuracy}

## Cost

Processor time is that of the process, without its start (for ORB-SLAM3, without reading the vocabulary). Memory is the
peak of the whole process. For ORB-SLAM3 both are of the first run. Our map is a surface. That of ORB-SLAM3 is a cloud
of points, which the wheel does not hand out: the table has its keyframes, and the median number of points that a frame
tracks.

{cost}
"""


def _command(options: argparse.Namespace) -> str:
    only = " --only " + " ".join(f"'{name}'" for name in options.only) if options.only else ""
    return (
        f"python tools/compare.py --data DATA --orb-python ORB_ENV/bin/python --vocabulary {options.vocabulary.name} "
        f"--weights {options.weights} --runs {options.runs} --pace {options.pace:g}{only}"
    )


def _parser() -> argparse.ArgumentParser:
    parser = parser_of(__doc__)
    add, data = parser.add_argument, os.environ.get("ERFSFM_DATA")
    add("--data", type=Path, default=data and Path(data), metavar="FOLDER", help="recordings; default: $ERFSFM_DATA")
    add("--orb-python", type=Path, required=True, metavar="FILE", help="Python of an environment with pyorbslam3")
    add("--vocabulary", type=Path, required=True, metavar="FILE", help="of ORB descriptors, text")
    add("--remarks", nargs="+", default=(), metavar="TEXT", help="for the page, such as where the vocabulary is from")
    add("--only", nargs="+", choices=[each.name for each in RECORDINGS], metavar="NAME", help="these recordings")
    add("--weights", default="sim", help="of our system (default: sim, which saw no real image)")
    add("--runs", type=int, default=1, help="of ORB-SLAM3 on each recording; ours runs once")
    add("--pace", type=float, default=0.15, help="speed of ORB-SLAM3's images over the recording's; 0: no waiting")
    add("--output", type=Path, default=Path("runs/comparison"), metavar="FOLDER", help="keeps the runs")
    add("--report", type=Path, default=Path("docs/comparison.md"), help="the page")
    return parser


if __name__ == "__main__":
    main()
