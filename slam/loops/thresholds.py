"""The conditions of a loop: between frames of a drive, and between keyframes of a hand-held camera's maps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

from slam.config.sections import LoopsConfig


@dataclass(frozen=True)
class LoopThresholds:
    """Independent of scale: pixels, ratios, degrees. Distances and drift of support are by frames or by keyframes.

    Attributes:
        min_inliers: least number of inliers in each direction.
        agreement_deg: largest difference of the rotations measured in both directions.
        agreement_ratio: largest difference of the translations measured in both directions, over the depth.
        min_support: least number of images with loops nearby that agree.
        max_hamming: largest Hamming distance of matching descriptors, bits.
        reprojection_px: largest reprojection error of an inlier.
        min_inlier_ratio: among the matches with depth.
        max_drift_ratio: largest correction over the path between both ends.
        support_distance: of both ends, within which loops must agree.
        support_drift_deg: rotation drift of the odometry between supporting loops, per frame or keyframe.
        alone_inliers: number of inliers from which on a loop needs no support.
    """

    min_inliers: int
    agreement_deg: float
    agreement_ratio: float
    min_support: int
    max_hamming: int = 64
    reprojection_px: float = 3.0
    min_inlier_ratio: float = 0.4
    max_drift_ratio: float = 0.3
    support_distance: int = 20
    support_drift_deg: float = 0.1
    alone_inliers: int = 120

    @classmethod
    def of_frames(cls, config: LoopsConfig) -> Self:
        """The conditions of loops between frames of a drive."""
        return cls(config.min_inliers, config.agreement_deg, config.agreement_ratio, config.min_support)


# keyframes' points are exact, their descriptors further apart in distance and roll; support counts keyframes
OF_KEYFRAMES = LoopThresholds(
    min_inliers=15,
    agreement_deg=4.0,
    agreement_ratio=0.15,
    min_support=1,
    max_hamming=100,
    reprojection_px=4.0,
    min_inlier_ratio=0.3,
    support_distance=4,
    support_drift_deg=0.5,
    alone_inliers=40,
)
