"""Protocol of poses: trained networks on snippets of sequences with true poses.

Constant velocity straight ahead, a baseline that uses no image, stands beside them.
"""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from erfsfm.common.errors import DataError
from erfsfm.common.readers.frame_range import FrameRange
from erfsfm.config import Fidelity
from erfsfm.data.discovery import named_recordings
from erfsfm.data.recordings import Recording
from erfsfm.evaluation.pose_metrics import (
    snippet_errors,
    snippet_from_network,
    snippets_from_trajectory,
)
from erfsfm.inference import DepthPosePredictor, refuse_leak


def pose_protocol(
    networks: DepthPosePredictor,
    root: Path,
    sequences: Sequence[str],
    fidelity: Fidelity,
    allow_leak: bool,
) -> list[dict[str, Any]]:
    """Five-frame snippets of each sequence, or of a part of it (``00[250:300]``): the networks, the pose network alone
    where its guess is the start of a measurement, and constant velocity straight ahead.

    No snippet spans a gap, and a stretch between gaps that is shorter than one is passed over. In paper fidelity the
    truth is that of camera 0, whichever camera took the images.

    Raises:
        DataError: a sequence or its poses are missing, networks of another snippet length, or a leak that was
            not allowed.
    """
    length = networks.sources + 1
    rows = []
    for name in sequences:
        parts = named_recordings(root, name)
        first, last = parts[0], parts[-1]
        shown = (
            str(FrameRange(first.name, first.start, last.start + len(last)))
            if "[" in name
            else first.name
        )
        leak = refuse_leak(networks, [part.frames_name for part in parts], allow_leak)
        if length != 5:
            raise DataError(
                f"the snippet protocol needs networks with 4 sources; these have {networks.sources}"
            )
        snippets, predicted = [], defaultdict(list)
        for part in parts:
            T_world_camera = part.true_poses(fidelity)
            if T_world_camera is None:
                raise DataError(f"no true poses of sequence {name}: wanted {root}/poses/{name}.txt")
            snippets.append(snippets_from_trajectory(T_world_camera, length))
            for images in _windows(part, networks):
                guess = networks.guessed_poses(images)
                poses = networks.measured_poses(guess, images, part.camera)
                predicted["networks"].append(snippet_from_network(poses))
                if networks.measures:
                    predicted["pose network alone"].append(snippet_from_network(guess))
        if not predicted:
            longest = max(map(len, parts))
            raise DataError(f"{shown} has {longest} frames without a gap; a snippet needs {length}")
        true = np.concatenate(snippets)
        straight = np.tile(np.eye(4), (len(true), length, 1, 1))
        straight[:, :, 2, 3] = np.arange(length)
        predicted["straight constant motion"] = list(straight)
        for method, snippet_poses in predicted.items():
            errors = asdict(snippet_errors(np.stack(snippet_poses), true, fidelity=fidelity))
            count = errors.pop("count")
            rows.append(
                {"method": method, "recording": shown, **errors, "snippets": count, "leak": leak}
            )
    return rows


def _windows(
    recording: Recording, networks: DepthPosePredictor
) -> Iterator[list[NDArray[np.float32]]]:
    """The prepared images of each snippet; no more of them are held than one has."""
    images: deque[NDArray[np.float32]] = deque(maxlen=networks.sources + 1)
    for index in range(len(recording)):
        images.append(
            networks.prepare(
                recording.image(index, recording.camera.height, recording.camera.width)
            )
        )
        if len(images) == images.maxlen:
            yield list(images)
