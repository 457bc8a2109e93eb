"""Depth errors as the field reports them (Eigen et al. 2014): crop, cap and scaling are always stated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

MINIMUM_DEPTH_M = 1e-3
CAP_M = 80.0  # farther truth is not compared
Crop = Literal["none", "garg"]
Clipping = Literal["after", "before"]


@dataclass(frozen=True)
class DepthErrors:
    """Means over the compared pixels; ``scale`` is the factor on the prediction."""

    abs_rel: float
    sq_rel: float
    rmse: float
    rmse_log: float
    a1: float
    a2: float
    a3: float
    scale: float


def valid_pixels(true_depth: NDArray[np.float32], cap_m: float, crop: Crop) -> NDArray[np.bool_]:
    """Pixels that count ``(H, W)``: truth known and under the cap, inside the crop of Garg et al. 2016."""
    mask = (true_depth > MINIMUM_DEPTH_M) & (true_depth < cap_m)
    if crop == "garg":
        height, width = true_depth.shape
        inside = np.zeros_like(mask)
        rows = slice(int(0.40810811 * height), int(0.99189189 * height))
        columns = slice(int(0.03594771 * width), int(0.96405229 * width))
        inside[rows, columns] = True
        mask &= inside
    return mask


def depth_errors(
    predicted: NDArray[np.float32],
    true_depth: NDArray[np.float32],
    cap_m: float = 80.0,
    crop: Crop = "none",
    scaling: Literal["median"] | float = "median",
    clipping: Clipping = "after",
) -> DepthErrors | None:
    """Compare one depth map with the truth.

    Args:
        predicted: z-depth ``(H, W)``, positive.
        true_depth: z-depth in metres ``(H, W)``, 0 where unknown.
        cap_m: farther truth is not compared; the prediction is clipped to it.
        crop: part of the image that is compared.
        scaling: ``median`` multiplies the prediction by the ratio of the medians, a number by that number.
        clipping: ``after`` scaling is the field's rule; ``before``, and never after, is the paper's code.

    Returns:
        The errors, or None where no pixel has truth.
    """
    mask = valid_pixels(true_depth, cap_m, crop)
    if not mask.any():
        return None
    truth = true_depth[mask].astype(np.float64)
    guess = predicted[mask].astype(np.float64)
    if clipping == "before":
        guess = np.clip(guess, MINIMUM_DEPTH_M, cap_m)
    scale = float(np.median(truth) / np.median(guess)) if scaling == "median" else scaling
    guess = guess * scale
    if clipping == "after":
        guess = np.clip(guess, MINIMUM_DEPTH_M, cap_m)
    with np.errstate(divide="ignore"):  # a scale of 0 is infinitely wrong in ratios
        ratio, log_error = np.maximum(truth / guess, guess / truth), np.log(truth) - np.log(guess)
    return DepthErrors(
        abs_rel=float(np.mean(np.abs(truth - guess) / truth)),
        sq_rel=float(np.mean((truth - guess) ** 2 / truth)),
        rmse=float(np.sqrt(np.mean((truth - guess) ** 2))),
        rmse_log=float(np.sqrt(np.mean(log_error**2))),
        a1=float(np.mean(ratio < 1.25)),
        a2=float(np.mean(ratio < 1.25**2)),
        a3=float(np.mean(ratio < 1.25**3)),
        scale=scale,
    )


def standard_error(values: Sequence[float]) -> float | None:
    """Of the mean of independent values, such as one for each street; None for fewer than two."""
    return float(np.std(values, ddof=1) / np.sqrt(len(values))) if len(values) > 1 else None


def mean_ratio(values: Sequence[float], to: Sequence[float]) -> tuple[float, float | None]:
    """Geometric mean of the ratios of positive values, street by street, and its standard error over streets."""
    logarithms = np.log(np.asarray(values) / np.asarray(to))
    mean, spread = float(np.exp(logarithms.mean())), standard_error(logarithms.tolist())
    return mean, None if spread is None else mean * spread


def mean_errors(errors: list[DepthErrors]) -> DepthErrors:
    """Mean over images, at least one, each image counting once."""
    return DepthErrors(*np.mean([astuple(each) for each in errors], axis=0).tolist())
