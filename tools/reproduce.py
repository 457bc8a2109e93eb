"""Reproduce the paper's tables: train what is missing, evaluate it, and write ours beside the paper's figures.

The rows and the paper's figures are those of docs/design/reproduction.md. Frames are shrunk once for each size. The
command says first how long it will take, by some steps of each training, and goes on where it was when it is repeated.

Example: python tools/reproduce.py --kitti KITTI_ODOMETRY --raw KITTI_RAW --rows 'table1-*-416x128'
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shlex
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from shared.command import one_line_errors, parser_of

from erfsfm.common.errors import ConfigError, TrainingError
from erfsfm.common.files import write_atomically
from erfsfm.common.progress import Progress, duration, progress_bar, silent
from erfsfm.common.table import Table
from erfsfm.config import ExperimentConfig, load_experiment
from erfsfm.data.discovery import named_recordings
from erfsfm.data.prepared import write_prepared
from erfsfm.data.split import split_recordings
from erfsfm.evaluation.eigen import eigen_protocol, read_split
from erfsfm.evaluation.pose_protocols import pose_protocol
from erfsfm.inference import DepthPosePredictor
from erfsfm.model_record import read_record
from erfsfm.training.output_folder import OutputFolder
from erfsfm.training.run import prepare, train

GUIDE = Path(__file__).parents[1] / "docs" / "design" / "reproduction.md"
TESTED = ("09", "10")
_ROW = re.compile(r"^\| `(table\d-\S+)` \| (.+) \|$", re.MULTILINE)
_DEPTH = ("abs_rel", "sq_rel", "rmse", "a1")
_TIMED_STEPS, _FIRST_STEPS = 20, 4  # the first ones allocate and choose algorithms
Results = dict[str, list[dict[str, Any]]]


@dataclass(frozen=True)
class Row:
    """A row of the paper; its scale is empty in the table of poses."""

    training: str
    scale: str
    figures: tuple[str, ...]


def paper_rows(patterns: Sequence[str]) -> list[Row]:
    """The rows of the guide whose trainings match any of the patterns.

    Raises:
        ConfigError: no training matches.
    """
    rows = []
    for name, cells in _ROW.findall(GUIDE.read_text(encoding="utf-8")):
        first, *rest = cells.split(" | ")
        has_scale = first in ("GT", "PoseNet")
        if any(fnmatch(name, pattern) for pattern in patterns):
            rows.append(
                Row(name, first if has_scale else "", tuple(rest) if has_scale else (first, *rest))
            )
    if not rows:
        raise ConfigError(f"{' '.join(patterns)} names no training of {GUIDE.name}")
    return rows


class Training:
    """One training of the paper, and what of it is done in its folder."""

    def __init__(self, name: str, output: Path, kitti: Path, changes: Sequence[str]) -> None:
        self.name, self.folder = name, output / name
        self.config = load_experiment(name, changes).with_roots([kitti])
        self.frames = (
            output / "frames" / f"{self.config.network.width}x{self.config.network.height}"
        )

    def steps_left(self) -> int:
        """After its latest weights."""
        record = self.folder / "last" / "model.yaml"
        return self.config.training.steps - (read_record(record).step if record.is_file() else 0)

    def seconds_a_step(self, device: str) -> float:
        """Measured on frames that are shrunk, as those of the training."""
        recordings, _ = split_recordings(self.config.data)
        parts = [each.part(0, min(len(each), 60)) for each in recordings[:4]]
        done_at: dict[int, float] = {}
        with tempfile.TemporaryDirectory() as temporary:
            frames = Path(temporary) / "frames"
            write_prepared(frames, parts, [], None, self.config.network, silent)
            config = _changed(self.config, "data", roots=[frames], validation=[])
            config = _changed(config, "training", steps=_FIRST_STEPS + _TIMED_STEPS)
            run = Path(temporary) / "run"
            train(
                config,
                run,
                device=device,
                progress=lambda _, done, __: done_at.update({done: time.monotonic()}),
            )
        return (done_at[max(done_at)] - done_at[_FIRST_STEPS]) / _TIMED_STEPS

    def run(self, device: str, progress: Progress) -> None:
        """Train what is left of it."""
        if not self.frames.is_dir():
            prepare(self.config, self.frames, progress)
        config = _changed(self.config, "data", roots=[self.frames])
        resume = OutputFolder(self.folder).checkpoint.is_file()
        train(config, self.folder, resume, device, shlex.join(sys.argv), progress)

    def evaluate(self, kitti: Path, raw: Path | None, split: str, device: str) -> Results:
        """Rows of snippets and of depth, kept in its folder; those of depth once there is ``raw``."""
        file = self.folder / "paper.json"
        kept: Results = json.loads(file.read_text()) if file.is_file() else {}
        predictor = DepthPosePredictor.from_weights(str(self.folder), device)
        if "pose" not in kept:
            kept["pose"] = pose_protocol(predictor, kitti, TESTED, "paper", allow_leak=False)
        if "depth" not in kept and raw is not None:
            kept["depth"] = eigen_protocol(predictor, raw, split, "paper", allow_leak=True)
        write_atomically(file, json.dumps(kept, indent=2) + "\n")
        return kept


def _changed(config: ExperimentConfig, section: str, **values: Any) -> ExperimentConfig:
    return config.model_copy(update={section: getattr(config, section).model_copy(update=values)})


def ours(row: Row, results: Results) -> list[str]:
    """Our figures in the columns of the paper; a dash where there is none."""
    if not row.scale:
        figures = []
        for each in results.get("pose", []):
            if each["method"] == "networks":
                for key in ("ate", "re"):
                    figures.append(f"{each[f'{key}_mean']:.4f} ± {each[f'{key}_std']:.4f}")
    else:
        scaling = {"GT": "gt-median", "PoseNet": "pose"}[row.scale]
        depth = next((each for each in results.get("depth", []) if each["scaling"] == scaling), {})
        figures = [f"{depth[key]:.4f}" for key in _DEPTH if depth.get(key) is not None]
    return figures or ["-"] * len(row.figures)


def tables(rows: Sequence[Row], results: dict[str, Results]) -> str:
    """Markdown: of each row the paper's figures and ours."""
    heads = {"09 ATE | 09 RE | 10 ATE | 10 RE": False, "Abs Rel | Sq Rel | RMSE | d < 1.25": True}
    parts = []
    for head, of_depth in heads.items():
        lines = []
        for row in rows:
            if bool(row.scale) == of_depth:
                start = [f"`{row.training}`", row.scale or "each snippet's"]
                lines += [
                    [*start, "paper", *row.figures],
                    [*start, "ours", *ours(row, results.get(row.training, {}))],
                ]
        parts += (
            [Table(["training", "scale", "by", *head.split(" | ")], lines, names=3).markdown()]
            if lines
            else []
        )
    return "\n\n".join(parts) + "\n"


def _say_how_long(trainings: Sequence[Training], device: str) -> None:
    total = 0.0
    for training in trainings:
        if (steps := training.steps_left()) > 0:
            seconds = training.seconds_a_step(device)
            total += seconds * steps
            print(f"{training.name}: {steps} steps of {seconds:.3g} s", file=sys.stderr)
    print(
        f"all trainings: {duration(total)}, and what shrinking frames and evaluating takes",
        file=sys.stderr,
    )


def _require_tested(kitti: Path, raw: Path | None, split: str) -> None:
    """Refuse data without what is evaluated at the end, days later."""
    for name in TESTED:
        if any(part.true_poses("paper") is None for part in named_recordings(kitti, name)):
            raise TrainingError(
                f"no true poses of sequence {name}: wanted {kitti}/poses/{name}.txt"
            )
    for frame in read_split(split, raw) if raw is not None else ():
        frame.image_path()


def _parser() -> argparse.ArgumentParser:
    parser = parser_of(__doc__)
    add = parser.add_argument
    add(
        "--kitti",
        type=Path,
        required=True,
        metavar="ROOT",
        help="KITTI odometry, colour, with poses",
    )
    add(
        "--raw",
        type=Path,
        metavar="ROOT",
        help="KITTI raw: the folder of the dates, with LiDAR, for depth",
    )
    add(
        "--rows",
        nargs="+",
        default=["*"],
        metavar="TRAINING",
        help="of the tables, * for any letters; all without it",
    )
    add(
        "--output",
        type=Path,
        default=Path("runs/paper"),
        help="keeps shrunk frames and trainings; gets tables.md",
    )
    add("--split", default="eigen", help="frames of --raw to test on, in place of the paper's")
    add(
        "--set",
        nargs="+",
        default=[],
        metavar="KEY=VALUE",
        help="changes to every training: not the paper's any more",
    )
    add(
        "--device",
        choices=("auto", "cpu", "cuda"),
        default="auto",
        help="where the networks compute",
    )
    return parser


@one_line_errors()
def main(words: Sequence[str] | None = None) -> None:
    """Train what is missing, evaluate, write the tables after every training."""
    options = _parser().parse_args(words)
    workers = min(max((os.cpu_count() or 2) - 1, 1), 8)
    changes = [f"data.workers={workers}", f"data.cache_mb={8000 // workers}", *options.set]
    rows = paper_rows(options.rows)
    names = dict.fromkeys(row.training for row in rows)
    trainings = [Training(name, options.output, options.kitti, changes) for name in names]
    _require_tested(options.kitti, options.raw, options.split)
    _say_how_long(trainings, options.device)
    results, text = {}, ""
    with progress_bar() as progress:
        for training in trainings:
            if training.steps_left() > 0:
                training.run(options.device, progress)
            results[training.name] = training.evaluate(
                options.kitti, options.raw, options.split, options.device
            )
            text = tables(rows, results)
            write_atomically(options.output / "tables.md", text)
    print(text)


if __name__ == "__main__":
    main()
