"""Fit the noise of steps by image geometry, and what it is worth on drives that the fit did not see.

The ratios of ``VisualOdometryConfig`` (jitter, turns, neighbours) are those of greatest likelihood under Student's t;
every drive has the same weight. For each drive the table has the coverage of its steps with the ratios in use, and with
ratios fitted to all other drives.

Example: python tools/fit_step_noise.py KITTI:00 KITTI:02 KITTI:05 WORLD --weights sim
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import gtsam
import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.optimize import minimize
from shared.command import one_line_errors, parser_of

from erfsfm.inference import DepthPosePredictor
from slam.config.sections import VisualOdometryConfig, load_config
from slam.evaluation.coverage import LEVELS, squared_bound
from slam.frames import RelativePose
from slam.frontend.drive import Drive
from slam.frontend.factors import make_factors
from slam.frontend.network_factors import STUDENT_T_DOF
from slam.frontend.scale.metric_scale import Scale
from slam.frontend.step_table import StepTable
from slam.geometry.se3 import FloatArray, invert, umeyama
from slam.pipeline.batch import SlamPipeline
from slam.prediction.assembly import NetworkPredictor
from slam.runtime.errors import SlamError
from slam.sequences.catalogue import open_sequence

QUIET = ("mapping.enabled=false", "loops.enabled=false")


RATIOS = (
    "jitter_rotation_ratio",
    "jitter_direction_ratio",
    "turn_rotation_ratio",
    "neighbour_rotation_ratio",
    "neighbour_direction_ratio",
)
IN_USE = np.array([getattr(VisualOdometryConfig(), name) for name in RATIOS])


@dataclass(frozen=True)
class DriveSteps:
    """The steps of a drive, rotation then translation in the later camera.

    ``errors`` ``(F, 6)`` are at the true poses. Variances are ``corners`` ``(F, 6)``, and ``parts`` ``(5, F, 6)`` times
    the squared ratios.
    """

    name: str
    errors: FloatArray
    corners: FloatArray
    parts: FloatArray

    @classmethod
    def of(cls, name: str, steps: StepTable, scale: Scale, T_world_camera: FloatArray) -> DriveSteps:
        """Errors at true poses ``(N, 4, 4)`` in the unit of the scale."""
        factors = _factors(steps, scale, np.zeros(len(RATIOS)))
        errors = [
            gtsam.Pose3.Logmap(
                gtsam.Pose3(factor.T_from_to).between(
                    gtsam.Pose3(invert(T_world_camera[factor.from_index]) @ T_world_camera[factor.to_index])
                )
            )
            for factor in factors
        ]
        corners, *each = (
            np.array([factor.sigmas for factor in _factors(steps, scale, ratios)]) ** 2
            for ratios in np.vstack([np.zeros(len(RATIOS)), np.eye(len(RATIOS))])
        )
        return cls(name, np.array(errors), corners, np.array(each) - corners)

    def sigmas(self, ratios: FloatArray) -> FloatArray:
        """Of the steps ``(F, 6)``, by ratios ``(5,)``."""
        return np.asarray(np.sqrt(self.corners + np.tensordot(ratios**2, self.parts, axes=1)))

    def log_likelihood(self, ratios: FloatArray) -> float:
        """Mean over the steps, by a multivariate Student's t whose standard deviations are the sigmas."""
        sigmas = self.sigmas(ratios)
        squared = ((self.errors / sigmas) ** 2).sum(axis=1)
        tails = 0.5 * (STUDENT_T_DOF + 6.0) * np.log1p(squared / (STUDENT_T_DOF - 2.0))
        return float(-(tails + np.log(sigmas).sum(axis=1)).mean())

    def coverage(self, ratios: FloatArray) -> list[float]:
        """Ratio of the steps inside their bounds of ``LEVELS``."""
        squared = ((self.errors / self.sigmas(ratios)) ** 2).sum(axis=1)
        return [float((squared <= squared_bound(level / 100, STUDENT_T_DOF)).mean()) for level in LEVELS]


def fit(drives: Sequence[DriveSteps]) -> FloatArray:
    """The ratios ``(5,)`` of greatest likelihood."""

    def loss(logarithms: FloatArray) -> float:
        return -sum(drive.log_likelihood(np.exp(logarithms)) for drive in drives)

    start = np.log(IN_USE) + np.vstack([np.zeros(len(IN_USE)), 0.5 * np.eye(len(IN_USE))])
    options = {"initial_simplex": start, "maxfev": 5000, "xatol": 0.01, "fatol": 1e-5}
    return np.asarray(np.exp(minimize(loss, start[0], method="Nelder-Mead", options=options).x))


def measure(name: str, networks: DepthPosePredictor) -> DriveSteps:
    """The steps of a recording with true poses, ``ROOT`` or ``ROOT:SEQUENCE``.

    Raises:
        SlamError: it cannot be opened, or has no true poses.
    """
    root, _, sequence = name.partition(":")
    recording = open_sequence(Path(root), sequence or None)
    if recording.reference is None:
        raise SlamError(f"{name} has no true poses: give a recording with poses")
    predictor = NetworkPredictor(networks, recording.intrinsics)
    config = load_config(None, QUIET)
    found = SlamPipeline(recording, predictor, config).estimate()
    T_true = np.array(recording.reference)
    T_true[:, :3, 3] *= umeyama(found.optimised.positions, T_true[:, :3, 3], with_scale=True).scale
    return DriveSteps.of(Path(root).name + (sequence and f" {sequence}"), found.drive.steps, found.scale, T_true)


def _factors(steps: StepTable, scale: Scale, ratios: FloatArray) -> list[RelativePose]:
    """The triangulated steps with a length, as they enter the graph."""
    known = Drive(motions=[motion for ends, motion in steps.triangulated.items() if ends in scale.lengths])
    visual_odometry = VisualOdometryConfig(**dict(zip(RATIOS, ratios.tolist(), strict=True)))
    return make_factors(known, scale, visual_odometry)


@one_line_errors()
def main(words: Sequence[str] | None = None) -> None:
    """Measure all drives, fit, print one table."""
    parser = parser_of(__doc__)
    parser.add_argument("drives", nargs="+", metavar="ROOT[:SEQUENCE]", help="recordings with true poses")
    parser.add_argument("--weights", default="default")
    options = parser.parse_args(words)
    networks = DepthPosePredictor.from_weights(options.weights, runtime="onnx")
    drives = [measure(name, networks) for name in options.drives]
    shown = Table("drive", "steps", "50 / 90 / 95 %, in use", "50 / 90 / 95 %, fitted to the others")
    for drive in drives:
        others = fit([other for other in drives if other is not drive])
        covered = (" / ".join(f"{ratio:.2f}" for ratio in drive.coverage(ratios)) for ratios in (IN_USE, others))
        shown.add_row(drive.name, str(len(drive.errors)), *covered)
    console = Console(width=120)
    console.print(shown)
    for name, fitted, used in zip(RATIOS, fit(drives), IN_USE, strict=True):
        console.print(f"{name}: {fitted:.3g} fitted to all, {used:g} in use")


if __name__ == "__main__":
    main()
