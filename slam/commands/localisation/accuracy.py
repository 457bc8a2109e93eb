"""How right the poses of localised images are, where their truth is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.commands.localisation.localiser import Localisation, image_paths
from slam.evaluation.map import pose_similarity
from slam.formats.trajectory import read_trajectory
from slam.geometry.se3 import FloatArray, Similarity, invert, rotation_angle
from slam.results.folder import RunFolder
from slam.runtime.errors import RunError

WITHIN_M, WITHIN_DEG = 0.5, 2.0
_SAME_M = 1e-3  # between poses of one file and those of a run's reference
_SIZES = ("error_m", "error_deg", "world_error_m", "world_error_deg")


@dataclass(frozen=True)
class PoseError:
    """Distance (m) and angle (deg) between a pose and its truth: relative to the nearest frame of the map, and in the
    world, where the map's own error counts as well."""

    error_m: float
    error_deg: float
    world_error_m: float
    world_error_deg: float

    @property
    def success(self) -> bool:
        """Within 0.5 m and 2 degrees, relative to the nearest frame of the map."""
        return self.error_m <= WITHIN_M and self.error_deg <= WITHIN_DEG


@dataclass(frozen=True)
class MapTruth:
    """The trajectory of a map and its truth, ``(N, 4, 4)``, and the motion that takes the one to the other.

    ``to_truth`` is one rigid motion, so that a drift of the map is an error in the world; a similarity where the map
    has no metric scale.
    """

    T_world_camera: FloatArray
    T_true_camera: FloatArray
    to_truth: Similarity

    @classmethod
    def of(cls, run: RunFolder) -> MapTruth:
        """Of a run with a reference.

        Raises:
            RunError: the run has none.
        """
        reference, optimised = run.trajectory("reference"), run.trajectory("optimised")
        if reference is None or optimised is None or len(reference) != len(optimised):
            raise RunError(f"{run.path} has no reference, so that no error can be computed: leave out --truth")
        T_true_camera, T_world_camera = reference.T_world_camera, optimised.T_world_camera
        with_scale = not run.metrics().is_metric
        return cls(T_world_camera, T_true_camera, pose_similarity(T_true_camera, T_world_camera, with_scale))

    def error(self, found: Localisation, T_true_image: FloatArray) -> PoseError | None:
        """The error of an image; None where it was not found.

        Args:
            found: the image in the map.
            T_true_image: its true pose ``(4, 4)`` in metres, in the world of the run's reference: its first camera.
        """
        if found.T_world_camera is None or found.nearest_frame is None:
            return None
        T_near_found = invert(self.T_world_camera[found.nearest_frame]) @ found.T_world_camera
        T_near_found[:3, 3] *= self.to_truth.scale
        T_near_true = invert(self.T_true_camera[found.nearest_frame]) @ T_true_image
        moved = self.to_truth.apply_to_poses(found.T_world_camera[None])[0]
        return PoseError(*_between(T_near_true, T_near_found), *_between(T_true_image, moved))


def true_poses(truth: Path, images: Path, numbers: range, T_true_camera: FloatArray) -> FloatArray:
    """True poses of the images of these numbers, ``(N, 4, 4)``, from a KITTI or TUM file with a row for each image.

    They are in the world of a run's reference ``T_true_camera`` ``(M, 4, 4)``: where that is a part of the file they
    are moved to its first camera, else the file is in that world already.

    Raises:
        SlamError: the file cannot be read, or has another number of rows than there are images.
    """
    trajectory, count = read_trajectory(truth), len(image_paths(images))
    if len(trajectory) != count:
        raise RunError(f"{truth} has {len(trajectory)} poses and {images} {count} images: give each image a row")
    T_any_camera = trajectory.T_world_camera
    chosen = T_any_camera[numbers.start : numbers.stop : numbers.step]
    last = len(T_true_camera) - 1
    T_first_last = invert(T_any_camera[: max(count - last, 0)]) @ T_any_camera[last:]
    for first in np.flatnonzero(_is_same(T_first_last, T_true_camera[-1])).tolist():
        T_world_any = invert(T_any_camera[first])
        if _is_same(T_world_any @ T_any_camera[first : first + last + 1], T_true_camera).all():
            return T_world_any @ chosen
    return chosen


def summary(errors: Sequence[PoseError | None]) -> dict[str, Any]:
    """The success rate over all images, and quantiles over the found ones; null with a reason if none was found."""
    known = [error for error in errors if error is not None]
    numbers: dict[str, Any] = {
        "images": len(errors),
        "found": len(known),
        "success_rate": sum(error.success for error in known) / len(errors),
        "within_m": WITHIN_M,
        "within_deg": WITHIN_DEG,
    }
    for key in _SIZES:
        name = f"median_{key}"
        if known:
            numbers[name] = float(np.median([getattr(error, key) for error in known]))
        else:
            numbers |= {name: None, f"{name}_reason": "no image was found"}
    return numbers


def summary_line(numbers: dict[str, Any]) -> str:
    """The summary in words."""
    rate = f"{numbers['success_rate']:.0%} of {numbers['images']} images within {WITHIN_M:g} m and {WITHIN_DEG:g} deg"
    if numbers["median_error_m"] is None:
        return f"{rate}; none was found"
    return (
        f"{rate} of their place in the map; median error {numbers['median_error_m']:.3f} m and "
        f"{numbers['median_error_deg']:.3f} deg, in the world {numbers['median_world_error_m']:.3f} m and "
        f"{numbers['median_world_error_deg']:.3f} deg"
    )


def _is_same(T_a_b: FloatArray, T_other: FloatArray) -> NDArray[np.bool_]:
    """Which of the poses ``(..., 4, 4)`` are those of a reference, but for the digits of files."""
    return np.asarray(np.abs(T_a_b - T_other).max(axis=(-2, -1)) < _SAME_M)


def _between(T_world_one: FloatArray, T_world_other: FloatArray) -> tuple[float, float]:
    """Distance, and angle in degrees."""
    T_one_other = invert(T_world_one) @ T_world_other
    return float(np.linalg.norm(T_one_other[:3, 3])), float(np.rad2deg(rotation_angle(T_one_other[:3, :3])))
