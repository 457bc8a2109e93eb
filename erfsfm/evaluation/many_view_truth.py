"""Depth errors on drives without true depth: static surfaces measured from neighbouring frames at a run's poses."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from erfsfm.common.errors import DataError
from erfsfm.common.progress import Progress
from erfsfm.data.discovery import discover
from erfsfm.data.many_view_teacher import LARGEST_WIDTH, ManyViewTeacher
from erfsfm.data.recordings import Recording
from erfsfm.evaluation.depth_metrics import DepthErrors, depth_errors, mean_errors
from erfsfm.evaluation.protocols import named_recordings, refuse_leak
from erfsfm.evaluation.streets import EVERY
from erfsfm.inference import DepthPosePredictor

CAP_HEIGHTS = 50.0  # camera heights: some 80 m from a car's roof
LARGEST_RATIO = 1.3  # of the bounds of a pixel's depth; wider ones are no truth
SLAM_WEIGHTS = "default"
TRUTH_FOLDER = "truth"
_RATIOS = ("abs_rel", "rmse_log", "a1", "a2", "a3")  # errors without a unit: the scale is fitted


def many_view_protocol(
    networks: DepthPosePredictor,
    root: Path,
    sequences: Sequence[str],
    cache: Path | None,
    allow_leak: bool,
    progress: Progress,
) -> list[dict[str, Any]]:
    """Median-scaled depth errors where the many-view teacher knows the depth within ``LARGEST_RATIO``.

    What moves, shines or is seen by one neighbour alone is left out, so the errors are smaller than against LiDAR:
    compare rows of this protocol with each other.

    Args:
        networks: to evaluate.
        root: of a data set.
        sequences: recordings of it, or frames of one (``00[250:300]``); all where none is named.
        cache: receives poses and depth, for the next call; forgotten where None.
        allow_leak: evaluate also frames that the networks were trained on.
        progress: told of the stage, what is done, and of how many.

    Returns:
        One row for each recording; ``known`` is the share of pixels that were compared.

    Raises:
        DataError: no such recording, a leak that was not allowed, or no depth could be measured.
        TrainingError: a recording gives no trajectory or no scale.
    """
    recordings = [each for name in sequences for each in named_recordings(root, name)] or discover(root)
    with tempfile.TemporaryDirectory(prefix="erfsfm-truth-") as folder:
        return many_view_errors(networks, recordings, cache or Path(folder), allow_leak, progress)


def many_view_errors(
    networks: DepthPosePredictor, recordings: Sequence[Recording], cache: Path, allow_leak: bool, progress: Progress
) -> list[dict[str, Any]]:
    """`many_view_protocol` of recordings."""
    leaks = [refuse_leak(networks, [each.frames_name], allow_leak) for each in recordings]
    rows = []
    for recording, leak in zip(recordings, leaks):
        width, height = recording.camera.width, recording.camera.height
        ratio = min(1.0, LARGEST_WIDTH / width)
        # the teacher's labels are measured around a network's depth, and truth without any
        teacher = ManyViewTeacher(cache / TRUTH_FOLDER, (round(height * ratio), round(width * ratio)), EVERY)
        teacher.prepare([recording], networks.sources, SLAM_WEIGHTS, progress)
        errors, known = _compare(networks, recording, teacher)
        if not errors:
            raise DataError(f"no depth could be measured in {recording.frames_name}: the camera has to travel")
        mean, scales = mean_errors(errors), np.array([each.scale for each in errors])
        row = {"method": "networks", "recording": recording.frames_name} | {key: getattr(mean, key) for key in _RATIOS}
        row |= {"scale_spread": float(scales.std() / scales.mean()), "known": float(np.mean(known))}
        rows.append(row | {"images": len(errors), "leak": leak})
    return rows


def _compare(
    networks: DepthPosePredictor, recording: Recording, teacher: ManyViewTeacher
) -> tuple[list[DepthErrors], list[float]]:
    """Errors, and the share of known pixels, of each frame that has any."""
    drive = teacher.drive(recording)
    errors, known = [], []
    for target in drive.targets(networks.sources):
        truth = _depth(*drive.label(target))
        guess = networks.depth(recording.image(target, *truth.shape))
        found = depth_errors(guess, truth, CAP_HEIGHTS)
        if found is not None:
            errors.append(found)
            known.append(float(np.mean((truth > 0) & (truth < CAP_HEIGHTS))))
    return errors, known


def _depth(least: NDArray[np.float16], most: NDArray[np.float16]) -> NDArray[np.float32]:
    """Depth ``(H, W)`` in camera heights from the bounds of its inverse; 0 where they are too far apart."""
    low, high = least.astype(np.float32), most.astype(np.float32)
    narrow = (low > 0) & (high < LARGEST_RATIO * low)
    depth = np.zeros_like(low)
    depth[narrow] = 1 / np.sqrt(low[narrow] * high[narrow])
    return depth
