"""Calibration of networks whose noise is known."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from erfsfm.common.errors import DataError
from erfsfm.common.readers.frame_range import overlapping
from erfsfm.evaluation.noise_fit import PairErrors, calibrate, coverage, fit, pair_errors

ROTATION, LENGTH_RATIO, UNIT = 0.002, 0.05, 0.3
FloatArray = NDArray[np.float64]


def drive(seed: int, count: int = 260) -> FloatArray:
    rng = np.random.default_rng(seed)
    T_world_camera = np.tile(np.eye(4), (count, 1, 1))
    for k in range(1, count):
        step = np.eye(4)
        step[:3, :3] = Rotation.from_rotvec([0.0, 0.03 * np.sin(k / 20), 0.0]).as_matrix()
        step[2, 3] = 1.0 + 0.3 * rng.random()
        T_world_camera[k] = T_world_camera[k - 1] @ step
    return T_world_camera


Snippets = list[tuple[int, Sequence[int], FloatArray, FloatArray]]


def snippets(T_world_camera: FloatArray, seed: int, shared: float, residual_gain: float = 0.0) -> Snippets:
    """Direct poses in another unit.

    ``shared`` is the correlation of both directions' errors; the yaw of a pair has a further error of ``residual_gain``
    times its photometric residual.
    """
    rng = np.random.default_rng(seed)
    common: dict[tuple[int, int], FloatArray] = {}
    residual_of: dict[tuple[int, int], float] = {}
    found = []
    for target in range(2, len(T_world_camera) - 2):
        sources = [target - 2, target - 1, target + 1, target + 2]
        poses = []
        for source in sources:
            pair = (min(source, target), max(source, target))
            noise = common.setdefault(pair, rng.normal(size=6))
            noise = np.sqrt(shared) * noise + np.sqrt(1 - shared) * rng.normal(size=6)
            T = np.linalg.inv(T_world_camera[pair[0]]) @ T_world_camera[pair[1]]
            T[:3, 3] += LENGTH_RATIO * np.linalg.norm(T[:3, 3]) * (T[:3, :3] @ noise[3:])
            T[:3, :3] @= Rotation.from_rotvec(ROTATION * (pair[1] - pair[0]) * noise[:3]).as_matrix()
            residual = residual_of.setdefault(pair, 0.3 + float(rng.random()) ** 3)
            T[:3, :3] @= Rotation.from_rotvec([0.0, residual_gain * residual * noise[1], 0.0]).as_matrix()
            T[:3, 3] *= UNIT
            poses.append(T if source < target else np.linalg.inv(T))
        residuals = np.array([residual_of[min(source, target), max(source, target)] for source in sources])
        found.append((target, sources, np.stack(poses), residuals))
    return found


def errors(seed: int, shared: float = 0.8, residual_gain: float = 0.0) -> PairErrors:
    T_world_camera = drive(seed)
    return pair_errors(f"drive {seed}", snippets(T_world_camera, seed + 100, shared, residual_gain), T_world_camera)


# with little correlation, the disagreement of both directions explains part of each error; the rest is correlated more
@pytest.mark.parametrize(("shared", "least", "most"), [(0.2, 0.1, 0.6), (0.9, 0.75, 1.0)])
def test_known_noise_is_recovered_and_covers_an_unseen_drive(shared: float, least: float, most: float) -> None:
    noise = fit([errors(0, shared), errors(1, shared)], "abc")
    unseen = errors(2, shared)
    for frames in (1.0, 2.0):
        squares = (unseen.features[unseen.features[:, 0, 0] == frames] ** 2).mean(axis=0)
        sigmas = np.sqrt((noise.coefficients**2 * squares).sum(axis=0))
        np.testing.assert_allclose(sigmas[:3], ROTATION * frames, rtol=0.35)
        np.testing.assert_allclose(sigmas[3:], LENGTH_RATIO * np.sqrt(squares[2, 0]), rtol=0.35)
    assert least < min(noise.correlation) <= max(noise.correlation) < most
    assert coverage(unseen, noise) == pytest.approx([0.5, 0.9, 0.95], abs=0.07)


def test_a_few_gross_errors_do_not_widen_the_noise() -> None:
    clean, with_outliers = errors(0), errors(0)
    with_outliers.single[::25] += 5.0
    with_outliers.mean[::25] += 5.0
    before, after = (fit([e], "abc") for e in (clean, with_outliers))
    assert coverage(clean, after)[1] == pytest.approx(coverage(clean, before)[1], abs=0.06)


class ConstantMotion:
    """Networks that predict the same motion for all images."""

    sources = 4

    def __init__(self, seen: Sequence[str] = ()) -> None:
        self.seen = seen

    def depth(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        return np.ones(image.shape[:2], np.float32)

    def poses(self, images: Sequence[NDArray[np.uint8]]) -> FloatArray:
        T_source_target = np.tile(np.eye(4), (4, 1, 1))
        T_source_target[:, 2, 3] = 0.1 * np.array([2, 1, -1, -2])
        return T_source_target

    def leaks(self, names: Sequence[str]) -> list[str]:
        return overlapping(names, self.seen)


def test_the_command_refuses_leaks_short_drives_and_roots_without_truth(
    tmp_path: Path, write_root: Callable[..., Path]
) -> None:
    write_root(tmp_path, frames=9, step=(0.0, 0.0, 0.1))
    with pytest.raises(DataError, match="pairs of frames that move; wanted 50"):
        calibrate(ConstantMotion(), [tmp_path], (), False, "abc")
    with pytest.raises(DataError, match="leak"):
        calibrate(ConstantMotion(["kitti_odometry/00"]), [tmp_path], (), False, "abc")
    with pytest.raises(DataError, match=r"no 77 with true poses in .*: found kitti_odometry/00"):
        calibrate(ConstantMotion(), [tmp_path], ["00", "77"], False, "abc")
    (tmp_path / "poses/00.txt").unlink()
    with pytest.raises(DataError, match=r"no sequence with true poses in .*: found none"):
        calibrate(ConstantMotion(), [tmp_path], (), False, "abc")


def test_worlds_of_one_name_in_two_folders_are_two_drives(tmp_path: Path, write_root: Callable[..., Path]) -> None:
    cameras = ("image_2", "image_3")
    roots = [write_root(tmp_path / name, 30, cameras=cameras, seed=601, step=(0.0, 0.0, 0.1)) for name in "ab"]
    noise, rows = calibrate(ConstantMotion(), [*roots, roots[0]], (), False, "abc")
    assert noise.measured_on == ["simulated/601[0:30]"] * 2, "by one camera each"
    assert all(0 <= row["coverage_50"] <= 1 for row in rows)


def test_the_command_measures_a_drive(tmp_path: Path, write_root: Callable[..., Path]) -> None:
    write_root(tmp_path, frames=40, step=(0.0, 0.0, 0.1))
    noise, rows = calibrate(ConstantMotion(), [tmp_path], ["00"], False, "abc")
    assert [row["recording"] for row in rows] == noise.measured_on == ["kitti_odometry/00[0:40]"]
    assert rows[0]["coverage_95"] is None, "no other measured a noise for it"
    assert noise.pairs == rows[0]["pairs"] > 50 and noise.pose_sha256 == "abc"
    assert min(noise.frame) > 0


def test_noise_proportional_to_the_residual_is_recovered() -> None:
    residual_gain = 0.01
    noise = fit([errors(0, residual_gain=residual_gain), errors(1, residual_gain=residual_gain)], "abc")
    assert noise.residual[1] == pytest.approx(residual_gain, rel=0.4)
    assert max(noise.residual[0], noise.residual[2]) < 0.2 * residual_gain
    assert coverage(errors(2, residual_gain=residual_gain), noise) == pytest.approx([0.5, 0.9, 0.95], abs=0.07)
