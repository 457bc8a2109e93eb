"""Does a wider receptive field help? Every variant from scratch under one budget, several seeds, unseen worlds.

Pose variants are trained beside the plain depth network, depth variants beside the plain pose network. Finished
trainings are not repeated and interrupted ones are resumed, so the same command may be given again.

Example: python tools/study_receptive_field.py --worlds worlds --unseen unseen --report docs/receptive-field-study.md
"""

from __future__ import annotations

import argparse
import json
import resource
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from scipy.stats import ttest_ind

from erfsfm.checkpoint import commit
from erfsfm.config import ExperimentConfig, load_experiment
from erfsfm.data.discovery import discover
from erfsfm.data.snippets import split_recordings
from erfsfm.evaluation.protocols import depth_protocol, pose_protocol
from erfsfm.files import write_atomically
from erfsfm.inference import DepthPosePredictor
from erfsfm.networks.presets import describe
from erfsfm.training.run import train

POSE = ("posenet", "erf-posenet-dilated", "erf-posenet-dfc", "erf-posenet-dfcv2")
DEPTH = ("depthnet", "erf-depthnet-dilated", "erf-depthnet-dfc", "erf-depthnet-dfcv2")
LEVEL = 0.05  # of significance
PAIRS = [(DEPTH[0], pose) for pose in POSE] + [(depth, POSE[0]) for depth in DEPTH[1:]]

PAGE = """# Does a wider receptive field help?

The paper's question, for the networks here: every variant is trained from scratch under one budget and measured on
worlds that none of them saw. Pose variants are paired with the plain depth network, depth variants with the plain pose
network.

`{command}`

{steps} steps of {batch} snippets at {width}x{height}, depth at width {depth_width}, pose at width {pose_width}, {seeds}
seeds; trained on {training} simulated worlds, measured on {unseen}; commit {commit}. The objective is that of
`configs/erfsfm/study.yaml`: two-view teacher, then the photometric error as well. Mean and standard deviation over
seeds. CPU seconds are those of one training, with {threads} thread{plural}, data loading apart.

## Pose networks

{pose}

## Depth networks

{depth}

![Errors of every training]({figure})

## What follows

{conclusions}
"""


@dataclass(frozen=True)
class StudyRow:
    """One training, measured on unseen worlds. Errors as in the paper's protocols; lengths in the snippet's unit."""

    depth: str
    pose: str
    seed: int
    ate: float
    re: float
    abs_rel: float
    cpu_seconds: float


def main() -> None:
    """Train what is missing, measure, write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", type=Path, required=True, help="simulated worlds to train on")
    parser.add_argument("--unseen", type=Path, required=True, help="others to measure on, simulated with --depth")
    parser.add_argument("--config", default="study", help="budget and objective")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="changes to the configuration")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--output", type=Path, default=Path("runs/study"), help="receives every training")
    parser.add_argument("--report", type=Path, default=Path("docs/receptive-field-study.md"))
    arguments = parser.parse_args()
    cv2.setNumThreads(1)

    rows = []
    for seed in range(arguments.seeds):  # seed by seed, so that partial results compare the same seeds
        for depth, pose in PAIRS:
            config = load_experiment(
                arguments.config,
                [
                    f"network.depth={depth}",
                    f"network.pose={pose}",
                    f"training.seed={seed}",
                    f"data.roots=[{arguments.worlds}]",
                    f"teacher.cache={arguments.output / 'structure'}",
                    *arguments.set,
                ],
            )
            row = measured(config, arguments.output / f"{depth}_{pose}_{seed}", arguments.unseen)
            rows.append(row)
            print(json.dumps(asdict(row)), file=sys.stderr)
    write_page(arguments.report, rows, config, arguments.unseen)


def measured(config: ExperimentConfig, folder: Path, unseen: Path) -> StudyRow:
    """The row of one training, from its folder if it is there already."""
    kept = folder / "outcome.json"
    if kept.is_file():
        return StudyRow(**json.loads(kept.read_text()))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_utime
    train(config, folder, resume=(folder / "checkpoints" / "last.ckpt").is_file(), device="cpu")
    seconds = resource.getrusage(resource.RUSAGE_SELF).ru_utime - before
    networks = DepthPosePredictor.from_weights(str(folder / "last"))
    names = [r.name for r in discover(unseen)]
    poses = [r for r in pose_protocol(networks, unseen, names, "default", False) if r["method"] == "networks"]
    depth = next(r for r in depth_protocol(networks, unseen, False) if r["method"] == "networks")
    row = StudyRow(
        depth=config.network.depth,
        pose=config.network.pose,
        seed=config.training.seed,
        ate=float(np.mean([r["ate_mean"] for r in poses])),
        re=float(np.mean([r["re_mean"] for r in poses])),
        abs_rel=float(depth["abs_rel"]),
        cpu_seconds=seconds,
    )
    write_atomically(kept, lambda path: path.write_text(json.dumps(asdict(row))))
    return row


def write_page(report: Path, rows: Sequence[StudyRow], config: ExperimentConfig, unseen: Path) -> None:
    """Tables, picture and what follows from them."""
    figure = report.parent / "images" / "receptive_field_study.png"
    figure.parent.mkdir(parents=True, exist_ok=True)
    draw(figure, rows)
    threads = torch.get_num_threads()
    network, training = config.network, config.training
    page = PAGE.format(
        command="python tools/study_receptive_field.py --worlds worlds --unseen unseen",
        steps=training.steps,
        batch=training.batch,
        width=network.width,
        height=network.height,
        depth_width=network.depth_width,
        pose_width=network.pose_width,
        seeds=len({o.seed for o in rows}),
        training=len(split_recordings(config.data)[0]),
        unseen=len(discover(unseen)),
        commit=commit(),
        threads=threads,
        plural="" if threads == 1 else "s",
        pose=table(rows, "pose", network.pose_width),
        depth=table(rows, "depth", network.depth_width),
        figure=f"images/{figure.name}",
        conclusions=conclusions(rows),
    )
    write_atomically(report, lambda path: path.write_text(page))


def of_kind(rows: Sequence[StudyRow], kind: str) -> dict[str, list[StudyRow]]:
    """Trainings by the variant of one kind of network, the other kind plain."""
    names, plain = (POSE, DEPTH[0]) if kind == "pose" else (DEPTH, POSE[0])
    other = "depth" if kind == "pose" else "pose"
    return {name: [o for o in rows if getattr(o, kind) == name and getattr(o, other) == plain] for name in names}


def table(rows: Sequence[StudyRow], kind: str, width: float) -> str:
    """Markdown rows: cost and errors of each variant."""
    cost = {summary.name: summary for summary in describe(width=width)}
    lines = [
        "| network | field (px) | parameters | multiply-adds | CPU s | snippet ATE | snippet RE (rad) | AbsRel |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, runs in of_kind(rows, kind).items():
        summary = cost[name]
        work = f"{summary.multiply_adds / 1e6:.0f} M" if summary.multiply_adds else "-"
        figures = [spread([getattr(o, field) for o in runs], 4) for field in ("ate", "re", "abs_rel")]
        seconds = np.median([o.cpu_seconds for o in runs])
        lines.append(
            f"| `{name}` | {summary.receptive_field} | {summary.parameters:,} | {work} | {seconds:.0f} | "
            f"{' | '.join(figures)} |"
        )
    return "\n".join(lines)


def spread(values: Sequence[float], digits: int) -> str:
    """Mean and sample standard deviation."""
    deviation = np.std(values, ddof=1) if len(values) > 1 else 0.0
    return f"{np.mean(values):.{digits}f} ± {deviation:.{digits}f}"


def conclusions(rows: Sequence[StudyRow]) -> str:
    """Each variant against the plain one, by Welch's t-test."""
    lines = []
    for kind, fields in (("pose", ("ate", "re")), ("depth", ("abs_rel",))):
        groups = of_kind(rows, kind)
        plain_name, *wider = groups
        for name in wider:
            for field in fields:
                a = np.array([getattr(o, field) for o in groups[plain_name]])
                b = np.array([getattr(o, field) for o in groups[name]])
                p = float(ttest_ind(a, b, equal_var=False).pvalue) if len(a) > 1 else 1.0
                change = 100 * (b.mean() / a.mean() - 1)
                word = ("better" if change < 0 else "worse") if p < LEVEL else "no clear difference"
                label = {"ate": "snippet ATE", "re": "snippet RE", "abs_rel": "AbsRel"}[field]
                lines.append(f"- `{name}` against `{plain_name}`: {label} {change:+.1f} % (p = {p:.2f}), {word}.")
    lines.append(f"\nClear means p < {LEVEL} in Welch's t-test; with so few seeds only large differences are.")
    if all("no clear difference" in line for line in lines[:-1]):
        lines.append(
            "\nNo variant is clearly better or worse than the plain networks: at this size and budget the paper's "
            "claim is neither confirmed nor refuted, and what the wider fields cost is certain."
        )
    return "\n".join(lines)


def draw(path: Path, rows: Sequence[StudyRow]) -> None:
    """One dot a training, a bar at each mean."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 3.4), layout="constrained")
    panels = (("pose", "ate", "snippet ATE"), ("pose", "re", "snippet RE (rad)"), ("depth", "abs_rel", "depth AbsRel"))
    for axes, (kind, field, label) in zip(figure.subplots(1, 3), panels):
        for place, runs in enumerate(of_kind(rows, kind).values()):
            values = [getattr(o, field) for o in runs]
            axes.plot([place] * len(values), values, "o", color="tab:blue", alpha=0.6)
            axes.plot([place - 0.25, place + 0.25], [np.mean(values)] * 2, "-", color="black")
        axes.set_xticks(range(4), ["plain", "dilated", "Dfc", "Dfcv2"])
        axes.set_title(f"{kind} networks", fontsize=10)
        axes.set_ylabel(label)
        axes.set_ylim(bottom=0)
        axes.grid(axis="y", alpha=0.3)
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main()
