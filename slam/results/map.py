"""The map of a run: its files and its accuracy."""

from __future__ import annotations

import logging
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.errors import SlamError
from slam.evaluation.map import accuracy_median_m, completeness, pose_similarity, visible_surface
from slam.frames import Sequence
from slam.pipeline.batch import SlamResult
from slam.results.folder import RunFolder
from slam.results.summary import null
from slam.se3 import apply
from slam.sequences.excerpt import Excerpt

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Surface:
    """The map as points for the report, and its numbers."""

    summary: dict[str, Any]
    points: NDArray[np.float64] | None = None
    colours: NDArray[np.float64] | None = None


def write_map(folder: RunFolder, result: SlamResult, sequence: Sequence) -> Surface:
    """Write mesh and cloud; an empty map gives a reason and no error.

    Raises:
        RunError: a file cannot be written.
    """
    if result.map is None:
        return Surface(_no_map("fusion is switched off (mapping.enabled)"))
    try:
        result.map.mesh(), result.map.cloud()
    except SlamError as error:
        logger.warning("no map: %s", error)
        return Surface(_no_map(str(error)))
    result.map.write_mesh(folder.path / "map_mesh.ply")
    result.map.write_cloud(folder.path / "map_cloud.ply")
    cloud = result.map.cloud()
    quality = _map_quality(cloud.points_world, result, sequence)
    return Surface(asdict(result.map.statistics()) | quality, cloud.points_world, cloud.colours)


def _no_map(reason: str) -> dict[str, Any]:
    names = ("triangles", "points", "blocks", "accuracy_median_m", "completeness")
    return {key: value for name in names for key, value in null(name, reason).items()}


def _map_quality(points: NDArray[np.float64], result: SlamResult, sequence: Sequence) -> dict[str, Any]:
    """Accuracy and completeness against the true street, after alignment of the trajectory."""
    base, first = (sequence.base, sequence.start) if isinstance(sequence, Excerpt) else (sequence, 0)
    street = getattr(base, "street", None)
    if result.reference is None or street is None:
        reason = "the true surface is known for the embedded simulated sequence only"
        return null("accuracy_median_m", reason) | null("completeness", reason)
    to_truth = pose_similarity(result.reference.T_world_camera, result.optimised.T_world_camera)
    T_street_first = street.T_world_camera[first]
    points_true = apply(T_street_first, to_truth.scale * points @ to_truth.R_a_b.T + to_truth.t_a_b)
    seen = [
        visible_surface(street.render(k).depth, sequence.intrinsics.K, street.T_world_camera[k], step=8)
        for k in range(first, first + len(sequence), 10)
    ]
    rng = np.random.default_rng(0)
    sample = points_true[rng.permutation(len(points_true))[:20_000]]
    return {
        "accuracy_median_m": accuracy_median_m(sample, street.distance_to_surface),
        "completeness": completeness(np.concatenate(seen), points_true),
    }
