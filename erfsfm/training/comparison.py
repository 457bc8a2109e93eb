"""Depth before and after a fine-tuning, on the frames that it kept to validate on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from erfsfm.common.progress import Progress
from erfsfm.config import ExperimentConfig
from erfsfm.data.snippets import split_recordings
from erfsfm.evaluation.many_view_truth import many_view_errors
from erfsfm.inference import DepthPosePredictor
from erfsfm.training.output_folder import MEASUREMENTS

_LEFT_OUT = ("method", "leak")  # the same in all rows


def depth_before_and_after(
    config: ExperimentConfig, output: Path, device: str, progress: Progress
) -> list[dict[str, Any]]:
    """Errors by many views, a row for each held-out stretch by the initial weights, then by the trained ones.

    Args:
        config: of the training, with initial weights.
        output: its weights.
        device: ``auto``, ``cpu`` or ``cuda``.
        progress: told of the stage, what is done, and of how many.

    Raises:
        DataError, TrainingError: no depth could be measured there.
    """
    _, validation = split_recordings(config.data)
    cache, rows = config.teacher.cache or output / MEASUREMENTS, []
    for when, weights in (("before", str(config.initial_weights)), ("after", str(output))):
        networks = DepthPosePredictor.from_weights(weights, device)
        errors = many_view_errors(networks, validation, cache, True, progress)
        rows += [{"depth": when} | {key: row[key] for key in row if key not in _LEFT_OUT} for row in errors]
    return rows
