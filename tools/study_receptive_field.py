"""Does a wider receptive field help? Every pose network under one budget, paired by seed, on drives that none saw.

The teacher is that of many views, whose poses supervise pose networks alone. Finished trainings are not repeated and
interrupted ones are resumed, so the same command may be given again.

Example: python tools/study_receptive_field.py --dataset pack --cache labels --report study.md
"""

from __future__ import annotations

import json
import resource
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.stats import t as student
from shared.command import markdown, one_line_errors, parser_of
from torch import Tensor

from erfsfm.checkpoint import load_model
from erfsfm.common.files import write_atomically
from erfsfm.config import ExperimentConfig, load_experiment
from erfsfm.data.recordings import Recording
from erfsfm.data.samples import in_unit_range
from erfsfm.data.snippets import ValidationSnippets, split_recordings
from erfsfm.evaluation.pose_metrics import snippet_errors, snippet_from_network
from erfsfm.geometry.transforms import pose_vector_to_matrix
from erfsfm.networks.presets import describe
from erfsfm.training.objective import to_network_range
from erfsfm.training.run import train

PLAIN = "posenet"
NETWORKS = [PLAIN, "erf-posenet-dilated", "erf-posenet-dfc"]
LEVEL = 0.95  # of the intervals
FIELDS = {
    "simulated_ate": "ATE, worlds",
    "simulated_re": "RE, worlds",
    "real_ate": "ATE, KITTI",
    "real_re": "RE, KITTI",
}

REPORT = """`{command}`

{steps} steps of {batch} snippets at {width}x{height} and width {pose_width}, learning rate {rate:g}; {seeds} seeds;
{training} drives and worlds. Mean and standard deviation over seeds of snippet ATE and RE (radians) on {unseen} unseen
snippets; CPU seconds of one training with one thread.

{table}

Ratio of the errors of a wider network and its plain one: geometric mean over the pairs, and its {level:.0f} % interval
(Student's t on the logarithms).

{differences}
"""


@dataclass(frozen=True)
class StudyRow:
    """One training, measured on unseen snippets. Errors as in the paper's protocol; lengths in metres."""

    pose: str
    seed: int
    simulated_ate: float
    simulated_re: float
    real_ate: float
    real_re: float
    cpu_seconds: float


@dataclass(frozen=True)
class UnseenSnippets:
    """Images in [-1, 1] and true ``T_source_target`` of snippets of one kind of drive."""

    samples: list[tuple[Tensor, list[Tensor], NDArray[np.float64]]]

    @classmethod
    def of(cls, recordings: Sequence[Recording], config: ExperimentConfig) -> UnseenSnippets:
        """Evenly spaced ones of some recordings."""
        samples = []
        snippets = ValidationSnippets(recordings, config)
        for number in range(len(snippets)):
            sample = in_unit_range(snippets[number])
            images = [to_network_range(image)[None] for image in sample["sources"]]
            samples.append((to_network_range(sample["target"])[None], images, sample["T_source_target"].numpy()))
        return cls(samples)

    @torch.inference_mode()
    def errors(self, network: torch.nn.Module) -> tuple[float, float]:
        """Mean snippet ATE and RE of a pose network."""
        predicted, true = [], []
        for target, sources, T_source_target in self.samples:
            vectors = network(target, sources)
            predicted.append(snippet_from_network(pose_vector_to_matrix(vectors[0].double()).numpy()))
            true.append(snippet_from_network(T_source_target))
        errors = snippet_errors(np.stack(predicted), np.stack(true))
        return errors.ate_mean, errors.re_mean


@one_line_errors()
def main() -> None:
    """Train what is missing, measure, print tables."""
    parser = parser_of(__doc__)
    parser.add_argument("--dataset", type=Path, action="append", required=True, help="to train and to measure on")
    parser.add_argument("--cache", type=Path, required=True, help="the teacher's poses; made where missing")
    parser.add_argument("--config", default="study", help="budget and objective")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="changes to the configuration")
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--networks", nargs="+", default=NETWORKS, choices=NETWORKS, help="only these")
    parser.add_argument("--output", type=Path, default=Path("runs/study"), help="receives every training")
    parser.add_argument("--report", type=Path, help="file for what is printed; the last is in docs/design/networks.md")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    torch.set_num_threads(1)

    roots = f"data.roots=[{','.join(map(str, arguments.dataset))}]"
    common = load_experiment(arguments.config, [roots, f"teacher.cache={arguments.cache}", *arguments.set])
    training, held_out = split_recordings(common.data)
    worlds = [recording for recording in held_out if recording.name.startswith("simulated/")]
    drives = [recording for recording in held_out if recording not in worlds]
    unseen = {"simulated": UnseenSnippets.of(worlds, common), "real": UnseenSnippets.of(drives, common)}
    rows = []
    for seed in range(arguments.seeds):  # seed by seed, so that partial results compare the same seeds
        for pose in arguments.networks:
            row = measured(of_run(common, pose, seed), arguments.output / f"{pose}_{seed}", unseen)
            rows.append(row)
            print(json.dumps(asdict(row)), file=sys.stderr, flush=True)
    text = report(rows, common, len(training), unseen)
    print(text)
    if arguments.report:
        write_atomically(arguments.report, lambda path: path.write_text(text))


def of_run(common: ExperimentConfig, pose: str, seed: int) -> ExperimentConfig:
    """The experiment of one training; nothing is validated on the way."""
    tree = common.model_dump()
    tree["network"]["pose"] = pose
    tree["training"]["seed"] = seed
    tree["data"]["exclude"] += tree["data"]["validation"]
    tree["data"]["validation"] = []
    return ExperimentConfig.model_validate(tree)


def measured(config: ExperimentConfig, folder: Path, unseen: dict[str, UnseenSnippets]) -> StudyRow:
    """The row of one training, from its folder if it is there already."""
    kept = folder / "outcome.json"
    if kept.is_file():
        return StudyRow(**json.loads(kept.read_text()))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_utime
    train(config, folder, resume=(folder / "checkpoints" / "last.ckpt").is_file(), device="cpu")
    seconds = resource.getrusage(resource.RUSAGE_SELF).ru_utime - before
    network = load_model(folder / "last").pose_net.eval()
    simulated, real = (unseen[kind].errors(network) for kind in ("simulated", "real"))
    row = StudyRow(config.network.pose, config.training.seed, *simulated, *real, seconds)
    write_atomically(kept, lambda path: path.write_text(json.dumps(asdict(row))))
    return row


def report(rows: Sequence[StudyRow], config: ExperimentConfig, training: int, unseen: dict[str, UnseenSnippets]) -> str:
    """Both tables under their command."""
    seeds, settings = len({row.seed for row in rows}), config.training
    return REPORT.format(
        command="python tools/study_receptive_field.py --dataset pack --cache labels "
        f"--seeds {seeds} --networks {' '.join(by_network(rows))}",
        **config.network.model_dump(include={"width", "height", "pose_width"}),
        **{"steps": settings.steps, "batch": settings.batch, "rate": settings.learning_rate},
        **{"seeds": seeds, "training": training, "level": 100 * LEVEL},
        unseen=", ".join(f"{len(snippets.samples)} {kind}" for kind, snippets in unseen.items()),
        table=table(rows, config.network.pose_width),
        differences=differences(rows),
    )


def by_network(rows: Sequence[StudyRow]) -> dict[str, list[StudyRow]]:
    """Trainings of each network by seed."""
    found = {name: sorted((row for row in rows if row.pose == name), key=lambda row: row.seed) for name in NETWORKS}
    return {name: runs for name, runs in found.items() if runs}


def table(rows: Sequence[StudyRow], width: float) -> str:
    """Markdown rows: cost and errors of each network."""
    cost = {summary.name: summary for summary in describe(width=width)}
    head = ["network", "field (px)", "parameters", "multiply-adds", "CPU s", *FIELDS.values()]
    cells = []
    for name, runs in by_network(rows).items():
        summary = cost[name]
        work = f"{summary.multiply_adds / 1e6:.0f} M" if summary.multiply_adds else "-"
        figures = [spread([getattr(row, field) for row in runs]) for field in FIELDS]
        seconds = np.median([row.cpu_seconds for row in runs])
        size = f"{summary.receptive_field}", f"{summary.parameters:,}"
        cells.append([f"`{name}`", *size, work, f"{seconds:.0f}", *figures])
    return markdown(head, cells)


def spread(values: Sequence[float]) -> str:
    """Mean and sample standard deviation."""
    deviation = np.std(values, ddof=1) if len(values) > 1 else 0.0
    return f"{np.mean(values):.4f} ± {deviation:.4f}"


def ratio_interval(plain: Sequence[StudyRow], wider: Sequence[StudyRow], field: str) -> tuple[float, float, float]:
    """Ratio of an error of paired trainings, and the ends of its interval."""
    seeds = sorted({row.seed for row in plain} & {row.seed for row in wider})
    logs = []
    for seed in seeds:
        one, other = (next(getattr(r, field) for r in runs if r.seed == seed) for runs in (plain, wider))
        logs.append(np.log(other / one))
    mean = float(np.mean(logs))
    if len(logs) < 2:
        return float(np.exp(mean)), 0.0, float("inf")
    half = float(student.ppf((1 + LEVEL) / 2, len(logs) - 1) * np.std(logs, ddof=1) / np.sqrt(len(logs)))
    return float(np.exp(mean)), float(np.exp(mean - half)), float(np.exp(mean + half))


def differences(rows: Sequence[StudyRow]) -> str:
    """Each wider network against the plain one, where that was trained too."""
    runs = by_network(rows)
    cells = []
    for name in [name for name in runs if name != PLAIN and PLAIN in runs]:
        ratios = ["{:.2f} ({:.2f} to {:.2f})".format(*ratio_interval(runs[PLAIN], runs[name], f)) for f in FIELDS]
        cells.append([f"`{name}` / `{PLAIN}`", *ratios])
    return markdown(["pair", *FIELDS.values()], cells)


if __name__ == "__main__":
    main()
