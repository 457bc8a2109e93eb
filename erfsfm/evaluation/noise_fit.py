"""The noise model of a pose network, fitted to its errors on held-out recordings.

Each of the six components is fitted by Student's t (4 degrees of freedom), which is robust to a few gross errors. One
common factor then makes the coverage of all six that of a Gaussian with these sigmas, as the pose graph assumes.
Every recording has the same weight, whatever its length.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.optimize import minimize
from scipy.stats import chi2

from erfsfm.common.errors import DataError
from erfsfm.data.discovery import discover
from erfsfm.data.recordings import Recording
from erfsfm.evaluation.protocols import PoseDepthNetworks, refuse_leak, windows
from erfsfm.photometric_residual import PhotometricResidual, thumbnail
from erfsfm.pose_noise import FloatArray, PoseNoise, Snippet, difference, pair_poses

logger = logging.getLogger(__name__)

LEVELS = (0.5, 0.9, 0.95)
_DEGREES = 4.0
_SCALE_FRAMES = 20
_LEAST_PAIRS = 50
_LEAST = 1e-6  # radians, or the networks' unit
_FACTORS = np.arange(0.6, 2.01, 0.02)


@dataclass(frozen=True)
class PairErrors:
    """Errors of P pairs of a recording, in the later camera and the networks' unit.

    ``mean`` ``(P, 6)`` of the mean of both directions, ``single`` ``(P, 2, 6)`` of each (NaN where there is one),
    ``features`` ``(P, 5, 6)`` as in `PairPose`.
    """

    recording: str
    mean: FloatArray
    single: FloatArray
    features: FloatArray

    def __len__(self) -> int:
        return len(self.mean)


def calibrate(
    networks: PoseDepthNetworks, roots: Sequence[Path], sequences: Sequence[str], allow_leak: bool, pose_sha256: str
) -> tuple[PoseNoise, list[dict[str, Any]]]:
    """Measure the noise of a pose network.

    Args:
        networks: trained networks.
        roots: KITTI odometry roots, real or simulated.
        sequences: names of sequences; none for all with true poses.
        allow_leak: also use recordings seen in training.
        pose_sha256: fingerprint of the pose network's file.

    Returns:
        The noise, and for each recording the coverage by the noise that the others give; None of one recording alone.

    Raises:
        DataError: nothing with true poses or one of the names, too little of it, or a leak that was not allowed.
    """
    recordings = [r for root in roots for r in discover(root) if r.sequence and r.poses_file]
    absent = [name for name in sequences if all(name not in (r.name, r.sequence) for r in recordings)]
    if absent or not recordings:
        names = ", ".join(dict.fromkeys(r.name for r in recordings)) or "none"
        raise DataError(
            f"no {' or '.join(absent) or 'sequence'} with true poses in {', '.join(map(str, roots))}, against which "
            f"noise is measured: found {names}"
        )
    recordings = [r for r in recordings if not sequences or {r.name, r.sequence} & set(sequences)]
    # one camera of a drive is enough; simulated worlds in two folders may have one name
    cameras = {(r.images[0].parents[1].resolve(), r.start): r for r in reversed(recordings)}
    refuse_leak(networks, [r.frames_name for r in cameras.values()], allow_leak)
    errors = [measure(networks, recording) for recording in cameras.values()]
    few = [e for e in errors if len(e) < _LEAST_PAIRS]
    if few:
        raise DataError(f"{few[0].recording} has {len(few[0])} pairs of frames that move; wanted {_LEAST_PAIRS}")
    if len(errors) == 1:
        logger.warning("one recording alone gives no coverage: it takes the noise measured on another")
    rows = []
    for k, held_out in enumerate(errors):
        others = errors[:k] + errors[k + 1 :]
        ratios = coverage(held_out, fit(others, pose_sha256)) if others else [None] * len(LEVELS)
        covered = {f"coverage_{100 * level:.0f}": ratio for level, ratio in zip(LEVELS, ratios, strict=True)}
        rows.append({"recording": held_out.recording, "pairs": len(held_out), **covered})
    return fit(errors, pose_sha256), rows


def measure(networks: PoseDepthNetworks, recording: Recording) -> PairErrors:
    """Errors of all pairs; the truth is scaled to the networks' unit, which is tracked along the drive."""
    T_world_camera = recording.true_poses()
    assert T_world_camera is not None
    half, camera = networks.sources // 2, recording.camera
    residual = PhotometricResidual(camera.K.astype(np.float64), camera.width, camera.height)
    snippets: list[Snippet] = []
    for target, images in enumerate(windows(networks, recording), start=half):
        sources = [k for k in range(target - half, target + half + 1) if k != target]
        T_source_target = networks.poses(images)
        thumbnails = [thumbnail(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)) for image in images]
        ratios = residual.ratios(thumbnails, np.reciprocal(networks.depth(images[half])), T_source_target)
        snippets.append((target, sources, T_source_target, ratios))
    return pair_errors(recording.frames_name, snippets, T_world_camera)


def pair_errors(name: str, snippets: Sequence[Snippet], T_world_camera: FloatArray) -> PairErrors:
    """Errors of what snippets measured against the truth ``(N, 4, 4)``."""
    pairs = pair_poses(snippets)
    true = [np.linalg.inv(T_world_camera[pair.first]) @ T_world_camera[pair.last] for pair in pairs]
    first = np.array([pair.first for pair in pairs])
    moved = np.array([np.linalg.norm(T[:3, 3]) for T in true])
    learned = np.array([np.linalg.norm(pair.T_first_last[:3, 3]) for pair in pairs])
    means, singles, features = [], [], []
    for k, pair in enumerate(pairs):
        near = (np.abs(first - pair.first) <= _SCALE_FRAMES) & (moved > 0)
        if not near.any():
            continue
        T_true = true[k].copy()
        T_true[:3, 3] *= np.median(learned[near] / moved[near])
        means.append(difference(pair.T_first_last, T_true))
        both = np.full((2, 6), np.nan)
        both[: pair.measurements] = [difference(T, T_true) for T in pair.directions]
        singles.append(both)
        features.append(pair.features)
    return PairErrors(name, *(np.array(rows) for rows in (means, singles, features)))


def fit(errors: Sequence[PairErrors], pose_sha256: str) -> PoseNoise:
    """The noise model fitted to the errors of some recordings."""
    laws = np.array([_fit_component(errors, k) for k in range(6)]).T  # (5, 6)
    spread = [np.sqrt((laws**2 * e.features**2).sum(axis=1)) for e in errors]  # (P, 6) each
    correlation = [_correlation(errors, spread, k) for k in range(6)]
    frame, turn, length, disagreement, residual = laws

    def noise(factor: float) -> PoseNoise:
        return PoseNoise(
            frame=_six(factor * frame),
            turn=_six(factor * turn),
            length=_six(factor * length),
            disagreement=_six(factor * disagreement),
            residual=_six(factor * residual),
            correlation=_six(np.array(correlation)),
            pose_sha256=pose_sha256,
            measured_on=[e.recording for e in errors],
            pairs=sum(map(len, errors)),
        )

    def worst(factor: float) -> float:
        misses = [np.abs(np.subtract(coverage(e, noise(factor)), LEVELS)) for e in errors]
        return float(np.mean(misses, axis=0).max())

    return noise(min(map(float, _FACTORS), key=worst))


def coverage(errors: PairErrors, noise: PoseNoise) -> list[float]:
    """Fraction of pairs whose whitened squared error lies inside the 50, 90 and 95 % quantile of chi-square(6)."""
    count = np.isfinite(errors.single[:, :, 0]).sum(axis=1)[:, None]
    merged = (1 + (count - 1) * np.array(noise.correlation)) / count
    squared = (errors.mean**2 / ((noise.coefficients**2 * errors.features**2).sum(axis=1) * merged)).sum(axis=1)
    return [float((squared <= chi2.ppf(level, 6)).mean()) for level in LEVELS]


def _six(values: FloatArray) -> tuple[float, float, float, float, float, float]:
    """Six numbers to four digits."""
    a, b, c, d, e, f = (float(f"{value:.4g}") for value in values)
    return a, b, c, d, e, f


def _fit_component(errors: Sequence[PairErrors], k: int) -> FloatArray:
    """Coefficients ``(5,)`` of one component by the likelihood of Student's t, single measurements, all recordings."""
    squares = [np.nanmean(e.single[:, :, k] ** 2, axis=1) for e in errors]
    features = [e.features[:, :, k] ** 2 for e in errors]
    typical = max(float(np.sqrt(np.median(np.concatenate(squares)))), _LEAST)
    sizes = np.sqrt(np.mean(np.concatenate(features), axis=0))
    units = typical / np.maximum(sizes, 1e-9)  # so that all unknowns are about one

    def cost(logs: FloatArray) -> float:
        total = 0.0
        for square, feature in zip(squares, features, strict=True):
            variance = feature @ (units * np.exp(logs)) ** 2 + (_LEAST * typical) ** 2
            heavy = 0.5 * (_DEGREES + 1) * np.log1p(square / variance / _DEGREES)
            total += float(np.mean(0.5 * np.log(variance) + heavy))
        return total

    best = minimize(cost, np.full(5, -0.7), method="L-BFGS-B", bounds=[(-7.0, 3.0)] * 5)
    return np.asarray(units * np.exp(best.x) * (sizes > 0) + _LEAST * (np.arange(5) == 0))


def _correlation(errors: Sequence[PairErrors], spread: Sequence[FloatArray], k: int) -> float:
    """Correlation of both directions' errors, clipped at three sigmas, between 0 and 1."""
    whitened = np.concatenate([e.single[:, :, k] / s[:, k, None] for e, s in zip(errors, spread, strict=True)])
    both = np.clip(whitened[np.isfinite(whitened).all(axis=1)], -3, 3)
    if len(both) < 2:
        return 1.0
    product, size = float((both[:, 0] * both[:, 1]).mean()), float((both**2).mean())
    return float(np.clip(product / max(size, 1e-12), 0.0, 1.0))
