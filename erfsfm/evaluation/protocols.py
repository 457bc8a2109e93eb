"""Evaluation protocols: trained networks on recordings with ground truth, beside a baseline that uses no image."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from erfsfm.common.errors import DataError
from erfsfm.common.readers.frame_range import EVERYTHING, FrameRange
from erfsfm.config import Fidelity
from erfsfm.data.discovery import discover
from erfsfm.data.recordings import Recording
from erfsfm.evaluation.depth_metrics import DepthErrors, depth_errors, mean_errors
from erfsfm.evaluation.pose_metrics import snippet_errors, snippet_from_network, snippets_from_trajectory

CAP_M = 80.0


class PoseDepthNetworks(Protocol):
    """Depth and pose networks as evaluations use them (``erfsfm.inference.DepthPosePredictor``)."""

    sources: int

    def depth(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Unscaled z-depth ``(H, W)``."""
        ...

    def poses(self, images: Sequence[NDArray[np.uint8]]) -> NDArray[np.float64]:
        """``T_source_target`` ``(N, 4, 4)``."""
        ...

    def leaks(self, names: Sequence[str]) -> list[str]:
        """Recordings that were trained on."""
        ...


def depth_protocol(networks: PoseDepthNetworks, root: Path, allow_leak: bool, every: int = 5) -> list[dict[str, Any]]:
    """Median-scaled depth errors under 80 m on every fifth frame with true depth.

    Returns:
        One row for the networks and one for the median depth map of the data, a baseline that uses no image.

    Raises:
        DataError: no true depth under the root, or a leak that was not allowed.
    """
    if any(root.glob("????_??_??/*_sync")):
        raise DataError(f"{root} holds KITTI raw drives: name their frames with --split eigen or --split FILE")
    recordings = [r for r in discover(root) if any(r.depth or ())]
    if not recordings:
        raise DataError(f"no true depth in {root}: wanted sequences/NN/depth_2 (erfsfm-slam simulate --depth)")
    leak = refuse_leak(networks, [r.frames_name for r in recordings], allow_leak)
    frames = [(r, i) for r in recordings for i in np.flatnonzero([file is not None for file in r.depth or ()])[::every]]
    truths = [r.true_depth(i) for r, i in frames]
    sizes = {t.shape for t in truths if t is not None}
    if len(sizes) > 1:
        raise DataError(f"depth maps of different sizes in {root}: evaluate recordings of one size at a time")
    typical = _median_map([t for t in truths if t is not None])
    rows: dict[str, list[DepthErrors]] = {"networks": [], "median depth map": []}
    for (recording, index), truth in zip(frames, truths):
        assert truth is not None
        image = recording.image(index, *truth.shape)  # of a pack the images are smaller
        for name, guess in (("networks", networks.depth(image)), ("median depth map", typical)):
            errors = depth_errors(guess, truth, CAP_M)
            if errors is not None:
                rows[name].append(errors)
    if not rows["networks"]:
        raise DataError(f"no depth between 0 and {CAP_M:g} m in {root}: nothing to compare with")
    return [_depth_row(name, errors, leak) for name, errors in rows.items()]


def pose_protocol(
    networks: PoseDepthNetworks, root: Path, sequences: Sequence[str], fidelity: Fidelity, allow_leak: bool
) -> list[dict[str, Any]]:
    """Five-frame snippets of each sequence, or of a part of it (``00[250:300]``): the networks, and
    constant velocity straight ahead.

    No snippet spans a gap, and a stretch between gaps that is shorter than one is passed over. In paper fidelity the
    truth is that of camera 0, whichever camera took the images.

    Raises:
        DataError: a sequence or its poses are missing, networks of another snippet length, or a leak that was
            not allowed.
    """
    return [row for name in sequences for row in _pose_rows(networks, root, name, fidelity, allow_leak)]


def named_recordings(root: Path, name: str) -> list[Recording]:
    """Recordings of a sequence, or their part that a name with frames means (``00[250:300]``); of its first camera.

    Raises:
        DataError: the sequence is missing, or has none of the frames.
    """
    found: dict[str, list[Recording]] = {}
    for each in discover(root):
        for known in {each.name, each.sequence or each.name}:
            found.setdefault(known, []).append(each)
    span = FrameRange(name, 0, EVERYTHING) if name in found else FrameRange.parse(name)
    if span.recording not in found:
        raise DataError(f"no sequence {span.recording} in {root}: found {', '.join(sorted(found)) or 'none'}")
    camera = found[span.recording][0].images[0].parent
    wholes = [whole for whole in found[span.recording] if whole.images[0].parent == camera]
    parts = [whole.within(span.start, span.stop) for whole in wholes]
    chosen = [part for part in parts if part is not None]
    if not chosen:
        raise DataError(f"{name} names no frame of a recording: found {', '.join(w.frames_name for w in wholes)}")
    return chosen


def _pose_rows(
    networks: PoseDepthNetworks, root: Path, name: str, fidelity: Fidelity, allow_leak: bool
) -> list[dict[str, Any]]:
    """The networks' row and that of the baseline, of all parts of a sequence."""
    length = networks.sources + 1
    parts = named_recordings(root, name)
    first, last = parts[0], parts[-1]
    shown = str(FrameRange(first.name, first.start, last.start + len(last))) if "[" in name else first.name
    leak = refuse_leak(networks, [part.frames_name for part in parts], allow_leak)
    if length != 5:
        raise DataError(f"the snippet protocol needs networks with 4 sources; these have {networks.sources}")
    snippets, predicted = [], []
    for part in parts:
        T_world_camera = part.true_poses(fidelity)
        if T_world_camera is None:
            raise DataError(f"no true poses of sequence {name}: wanted {root}/poses/{name}.txt")
        snippets.append(snippets_from_trajectory(T_world_camera, length))
        predicted += [snippet_from_network(networks.poses(images)) for images in windows(networks, part)]
    if not predicted:
        longest = max(map(len, parts))
        raise DataError(f"{shown} has {longest} frames without a gap; a snippet needs {length}")
    true = np.concatenate(snippets)
    straight = np.tile(np.eye(4), (len(true), length, 1, 1))
    straight[:, :, 2, 3] = np.arange(length)
    rows = []
    for method, guess in (("networks", np.stack(predicted)), ("straight constant motion", straight)):
        errors = snippet_errors(guess, true, fidelity=fidelity)
        row = {"method": method, "recording": shown, "ate_mean": errors.ate_mean, "ate_std": errors.ate_std}
        rows.append(row | {"re_mean": errors.re_mean, "re_std": errors.re_std, "snippets": errors.count, "leak": leak})
    return rows


def windows(networks: PoseDepthNetworks, recording: Recording) -> Iterator[list[NDArray[np.uint8]]]:
    """The images of each window of a pose network; no more of them are held than one window has."""
    images: deque[NDArray[np.uint8]] = deque(maxlen=networks.sources + 1)
    for index in range(len(recording)):
        images.append(recording.image(index, recording.camera.height, recording.camera.width))
        if len(images) == images.maxlen:
            yield list(images)


def _median_map(truths: list[NDArray[np.float32]]) -> NDArray[np.float32]:
    """Per-pixel median of the true depth, the sky at the cap; every map has the first one's size."""
    stacked = np.stack([np.where((t > 0) & (t < CAP_M), t, np.nan) for t in truths])
    known = np.isfinite(stacked).any(axis=0)
    median = np.full(stacked.shape[1:], CAP_M, dtype=np.float32)
    median[known] = np.nanmedian(stacked[:, known], axis=0)
    return median


def _depth_row(name: str, errors: list[DepthErrors], leak: bool) -> dict[str, Any]:
    mean = mean_errors(errors).as_dict()
    scales = np.array([e.scale for e in errors])
    spread = float(scales.std() / scales.mean())
    return {"method": name, **mean, "scale_spread": spread, "images": len(errors), "leak": leak}


def refuse_leak(networks: PoseDepthNetworks, names: Sequence[str], allow_leak: bool) -> bool:
    """Whether some of the frames were trained on.

    Raises:
        DataError: they were, and that was not allowed.
    """
    leaked = networks.leaks(names)
    if leaked and not allow_leak:
        some = ", ".join(leaked[:5]) + (f" and {len(leaked) - 5} more" if len(leaked) > 5 else "")
        raise DataError(
            f"leak: these weights were trained on {some}; choose other weights or data, or allow it with --allow-leak"
        )
    return bool(leaked)
