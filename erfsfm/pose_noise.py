"""The noise model of a pose network, fitted on held-out recordings and stored beside its weights.

Only the direct poses of a snippet are measurements. Overlapping snippets measure a pair of frames twice, once in each
direction, from nearly the same images: both errors are correlated, and a pair is one measurement, their mean. NumPy
alone, so that SLAM needs no torch for it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError
from scipy.spatial.transform import Rotation

from erfsfm.common.config_tree import Section, dump_yaml, first_problem
from erfsfm.common.errors import CheckpointError
from erfsfm.common.files import write_atomically
from erfsfm.common.yaml_file import YamlError, read_yaml

FloatArray = NDArray[np.float64]
# target, sources, T_source_target (N, 4, 4), photometric residuals (N,); None: residuals of 1
Snippet = tuple[int, Sequence[int], FloatArray, FloatArray | None]
NOISE_FILE = "noise.yaml"

_NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
_Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
_Six = tuple[_NonNegative, _NonNegative, _NonNegative, _NonNegative, _NonNegative, _NonNegative]


class PoseNoise(Section):
    """Sigmas of one direct pose, rotation x, y, z (radians) then translation x, y, z (the networks' unit).

    Their parts add in quadrature: ``frame`` for each frame between the two, ``turn`` times the rotation angle (for the
    translation: the angle a frame, times the length), ``length`` times the length moved, ``disagreement`` times the
    difference of the measurements in both directions, ``residual`` times the photometric residual
    (``erfsfm.photometric_residual``; for the translation times the length). ``correlation`` is that of the whitened
    errors of both directions.
    """

    format: Literal[1] = 1
    frame: tuple[_Positive, _Positive, _Positive, _Positive, _Positive, _Positive]
    turn: _Six
    length: _Six
    disagreement: _Six
    residual: _Six = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    correlation: tuple[
        Annotated[float, Field(ge=0, le=1)],
        Annotated[float, Field(ge=0, le=1)],
        Annotated[float, Field(ge=0, le=1)],
        Annotated[float, Field(ge=0, le=1)],
        Annotated[float, Field(ge=0, le=1)],
        Annotated[float, Field(ge=0, le=1)],
    ]
    pose_sha256: str = Field(description="of the pose network's file that this was measured with")
    measured_on: list[str] = Field(description="recordings and frame ranges")
    pairs: int = Field(ge=1, description="measured pairs of frames")

    @property
    def coefficients(self) -> FloatArray:
        """``(5, 6)``, in the order of `PairPose.features`."""
        return np.array([self.frame, self.turn, self.length, self.disagreement, self.residual])

    def sigmas(self, pair: PairPose) -> FloatArray:
        """Sigmas ``(6,)`` of the mean of a pair's measurements, in the later camera."""
        single = np.sqrt((self.coefficients**2 * pair.features**2).sum(axis=0))
        n = pair.measurements
        return np.asarray(single * np.sqrt((1.0 + (n - 1) * np.array(self.correlation)) / n))


@dataclass(frozen=True)
class PairPose:
    """Relative pose of two frames measured by snippets.

    Attributes:
        first: number of the earlier frame.
        last: number of the later frame.
        T_first_last: ``(4, 4)``, the mean of both directions, unscaled.
        directions: ``(M, 4, 4)``, the single measurements, one or two, each as ``T_first_last``.
        features: ``(5, 6)``, the regressors of the noise: frames, turn, length, disagreement of both directions,
            photometric residual.
    """

    first: int
    last: int
    T_first_last: FloatArray
    directions: FloatArray
    features: FloatArray

    @property
    def measurements(self) -> int:
        """1 or 2."""
        return len(self.directions)

    @property
    def turn(self) -> float:
        """The angle between both frames, radians."""
        return float(self.features[1, 0])


def pair_poses(snippets: Sequence[Snippet]) -> list[PairPose]:
    """Every measured pair of frames, once."""
    measured: dict[tuple[int, int], list[tuple[FloatArray, float]]] = {}
    for target, sources, T_source_target, residuals in snippets:
        ratios = np.ones(len(sources)) if residuals is None else residuals
        T_target_source = np.linalg.inv(T_source_target)
        for k, source in enumerate(sources):
            forward = source < target
            pair = (source, target) if forward else (target, source)
            T_first_last = np.asarray((T_source_target if forward else T_target_source)[k], dtype=np.float64)
            measured.setdefault(pair, []).append((T_first_last, float(ratios[k])))
    if not measured:
        return []
    pairs, directions = zip(*sorted(measured.items()), strict=True)
    poses = [np.stack([T for T, _ in each]) for each in directions]
    residual = np.array([np.mean([ratio for _, ratio in each]) for each in directions])
    T_first_last = _middle(*(np.stack([each[k] for each in poses]) for k in (0, -1)))
    features = _features(np.array(pairs), poses, T_first_last, residual)
    return [PairPose(*pair, *known) for pair, *known in zip(pairs, T_first_last, poses, features, strict=True)]


def _features(
    pairs: NDArray[np.int64], poses: Sequence[FloatArray], T_first_last: FloatArray, residual: FloatArray
) -> FloatArray:
    """``(P, 5, 6)`` of pairs ``(P, 2)``."""
    frames = (pairs[:, 1] - pairs[:, 0]).astype(np.float64)
    moved = tangent(T_first_last)
    turn, length = np.linalg.norm(moved[:, :3], axis=1), np.linalg.norm(moved[:, 3:], axis=1)
    disagreement = np.abs(difference(np.stack([each[0] for each in poses]), np.stack([each[-1] for each in poses])))
    disagreement[[len(each) == 1 for each in poses]] = 0.0

    def six(rotation: FloatArray, translation: FloatArray) -> FloatArray:
        return np.stack([rotation] * 3 + [translation] * 3, axis=1)

    rows = [six(frames, frames), six(turn, turn / frames * length), six(length, length), disagreement]
    return np.stack([*rows, six(residual, residual * length)], axis=1)


def tangent(T_a_b: FloatArray) -> FloatArray:
    """Rotation vector and translation ``(..., 6)`` of ``(..., 4, 4)``: GTSAM's order, for small differences."""
    R = T_a_b[..., :3, :3].reshape(-1, 3, 3)
    turned = Rotation.from_matrix(R).as_rotvec().reshape(*T_a_b.shape[:-2], 3)
    return np.concatenate([turned, T_a_b[..., :3, 3]], axis=-1)


def difference(T_a_b: FloatArray, T_a_b_other: FloatArray) -> FloatArray:
    """``tangent`` of the step from one measurement to another, in camera b."""
    return tangent(np.linalg.inv(T_a_b) @ T_a_b_other)


def read_pose_noise(folder: Path) -> PoseNoise | None:
    """The noise beside a folder's weights; None where it was never measured.

    Raises:
        CheckpointError: damaged, of another format, or measured with another pose network; one line.
    """
    path = folder / NOISE_FILE
    if not path.exists():
        return None
    try:
        return PoseNoise.model_validate(read_yaml(path))
    except YamlError as error:
        raise CheckpointError(f"{error}; remove it, and measure again with erfsfm calibrate-noise") from error
    except ValidationError as error:
        raise CheckpointError(
            f"{path} is not a noise record: {first_problem(error)}; remove it, and measure again with erfsfm "
            "calibrate-noise"
        ) from error


def write_pose_noise(folder: Path, noise: PoseNoise) -> None:
    """Put a noise record beside weights, whole or not at all."""
    text = dump_yaml(noise)
    write_atomically(folder / NOISE_FILE, lambda path: path.write_text(text))


def file_sha256(path: Path) -> str:
    """Fingerprint of a file; empty where there is none."""
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.exists() else ""


def _middle(T_a_b: FloatArray, T_a_b_other: FloatArray) -> FloatArray:
    """Midpoint of transforms ``(P, 4, 4)`` that are close together."""
    middle: FloatArray = 0.5 * (T_a_b + T_a_b_other)
    between = Rotation.from_matrix(np.swapaxes(T_a_b[:, :3, :3], 1, 2) @ T_a_b_other[:, :3, :3])
    half = Rotation.from_rotvec(0.5 * between.as_rotvec())
    middle[:, :3, :3] = (Rotation.from_matrix(T_a_b[:, :3, :3]) * half).as_matrix()
    return middle
