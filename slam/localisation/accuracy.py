"""How right the poses of localised images are, where their truth is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from slam.errors import RunError
from slam.evaluation.map import pose_similarity
from slam.localisation.localiser import Localisation, image_paths
from slam.results.comparison import lookup
from slam.results.folder import RunFolder
from slam.se3 import FloatArray, Similarity, invert, rotation_angle
from slam.trajectory import associate, read_trajectory

WITHIN_M, WITHIN_DEG = 0.5, 2.0


@dataclass(frozen=True)
class PoseError:
    """Distance and angle between a pose and its truth, both None for an image that was not found."""

    distance_m: float | None = None
    angle_deg: float | None = None

    @property
    def success(self) -> bool:
        """Found, within 0.5 m and 2 degrees."""
        return (
            self.distance_m is not None
            and self.angle_deg is not None
            and self.distance_m <= WITHIN_M
            and self.angle_deg <= WITHIN_DEG
        )


def true_poses(truth: Path, images: Path, numbers: range) -> FloatArray:
    """True poses of the images of these numbers, ``(N, 4, 4)``, from a KITTI or TUM file with a row for each image.

    Raises:
        SlamError: the file cannot be read, or has another number of rows than there are images.
    """
    trajectory, count = read_trajectory(truth), len(image_paths(images))
    if len(trajectory) != count:
        raise RunError(f"{truth} has {len(trajectory)} poses and {images} {count} images: give each image a row")
    return trajectory.T_world_camera[numbers.start : numbers.stop : numbers.step]


def map_to_truth(run: RunFolder) -> Similarity:
    """The motion that takes a map to the world of its run's reference, that of its first camera, in metres.

    It is one rigid motion of the whole trajectory, so that a drift of the map is an error of poses in it; a similarity
    where the map has no metric scale.

    Raises:
        RunError: the run has no reference.
    """
    reference, optimised = run.trajectory("reference"), run.trajectory("optimised")
    if reference is None or optimised is None:
        raise RunError(f"{run.path} has no reference, so that no error can be computed: leave out --truth")
    optimised, reference = associate(optimised, reference)
    with_scale = lookup(run.metrics(), "scale", "mode")[0] == "none"
    return pose_similarity(reference.T_world_camera, optimised.T_world_camera, with_scale)


def pose_errors(found: Sequence[Localisation], truth: FloatArray, to_truth: Similarity) -> list[PoseError]:
    """The error of each of N images.

    Args:
        found: the images.
        truth: ``T_world_camera`` of each, ``(N, 4, 4)``.
        to_truth: from the map to the world of ``truth``.
    """
    errors = []
    for each, T_true in zip(found, truth, strict=True):
        if each.T_world_camera is None:
            errors.append(PoseError())
            continue
        T_true_found = invert(T_true) @ to_truth.apply_to_poses(each.T_world_camera[None])[0]
        angle_deg = float(np.rad2deg(rotation_angle(T_true_found[:3, :3])))
        errors.append(PoseError(float(np.linalg.norm(T_true_found[:3, 3])), angle_deg))
    return errors


def summary(errors: Sequence[PoseError]) -> dict[str, Any]:
    """The success rate over all images, and medians over those that were found; null with a reason without any."""
    distances = [error.distance_m for error in errors if error.distance_m is not None]
    angles = [error.angle_deg for error in errors if error.angle_deg is not None]
    numbers: dict[str, Any] = {
        "images": len(errors),
        "found": len(distances),
        "success_rate": sum(error.success for error in errors) / len(errors),
        "within_m": WITHIN_M,
        "within_deg": WITHIN_DEG,
    }
    if not distances:
        missing = dict.fromkeys(("median_m", "90_m", "median_deg", "90_deg"))
        return numbers | missing | {f"{name}_reason": "no image was found" for name in missing}
    at_m, at_deg = np.quantile(distances, [0.5, 0.9]).tolist(), np.quantile(angles, [0.5, 0.9]).tolist()
    return numbers | {"median_m": at_m[0], "90_m": at_m[1], "median_deg": at_deg[0], "90_deg": at_deg[1]}


def summary_line(numbers: dict[str, Any]) -> str:
    """The summary in words."""
    rate = (
        f"{numbers['success_rate']:.0%} of {numbers['images']} images within {WITHIN_M:g} m and {WITHIN_DEG:g} degrees"
    )
    if numbers["median_m"] is None:
        return f"{rate}; none was found"
    return (
        f"{rate}; median error {numbers['median_m']:.3f} m and {numbers['median_deg']:.3f} degrees, "
        f"90 % within {numbers['90_m']:.3f} m and {numbers['90_deg']:.3f} degrees of those found"
    )
