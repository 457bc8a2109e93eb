"""What teaches depth: measurements of many views, made before the first step, or a network that is imitated."""

from __future__ import annotations

from functools import lru_cache, partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from erfsfm.common.errors import ConfigError
from erfsfm.common.progress import Progress
from erfsfm.config import ExperimentConfig
from erfsfm.data.exact_depth import by_label
from erfsfm.data.many_view_teacher import Learned, ManyViewTeacher
from erfsfm.data.recordings import Recording
from erfsfm.data.snippets import labels_mb
from erfsfm.inference import DepthPosePredictor
from erfsfm.model_record import find_weights, read_record


def learned_inverse_depth(weights: str, image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """``(H, W)``, unscaled, of an image ``(H, W, 3)``, by the networks whose poses the teacher uses."""
    return np.reciprocal(_predictor(weights).depth(image))


@lru_cache(maxsize=1)
def _predictor(weights: str) -> DepthPosePredictor:
    """In this process."""
    return DepthPosePredictor.from_weights(weights, "cpu", "onnx")


def imitated(config: ExperimentConfig) -> Learned | None:
    """Inverse depth in network units as the reference camera would see it, by the network that is imitated, if any."""
    return partial(learned_inverse_depth, config.teacher.slam_weights) if config.teacher.views == "network" else None


def seen_by_imitated(config: ExperimentConfig) -> list[str]:
    """What the imitated network was trained on, and the network that imitates it has then seen, too.

    Raises:
        CheckpointError: there are no such weights.
        ConfigError: they have no depth network.
    """
    name = config.teacher.slam_weights
    if config.teacher.views != "network":
        return []
    record = read_record(find_weights(name) / "model.yaml")
    if record.networks == "pose":
        raise ConfigError(f"teacher.slam_weights '{name}' have no depth network to imitate: name weights that have one")
    return record.trained_on


def measured_views(
    recordings: list[Recording], config: ExperimentConfig, folder: Path, progress: Progress
) -> ManyViewTeacher | None:
    """The teacher, with what is not there yet measured; None where the experiment has no many views.

    Args:
        recordings: to train on; those with exact depth need no measurement.
        config: of the experiment.
        folder: of the measurements.
        progress: told of the stage, what is done, and of how many.
    """
    _, measured = by_label(recordings, config)
    if config.teacher.views != "many":
        return None
    size = (config.network.height, config.network.width)
    with_depth = config.training.networks != "pose"
    cache_mb = labels_mb(config.data)
    learned = partial(learned_inverse_depth, config.teacher.slam_weights)
    teacher = ManyViewTeacher(folder, size, config.teacher.stride, cache_mb, with_depth, learned)
    teacher.prepare(measured, config.network.sources, config.teacher.slam_weights, progress)
    return teacher
