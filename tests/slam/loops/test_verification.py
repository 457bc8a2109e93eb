"""Loops between two views of drawn points are verified, measured and refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slam.frames import LOOP_SOURCE, Intrinsics, View
from slam.geometry.se3 import FloatArray, apply, from_rotation_vector, invert, rotation_angle
from slam.loops import verification
from slam.loops.verification import OF_FRAMES, Loop, LoopVerifier, RejectedLoop

CAMERA = Intrinsics(width=416, height=128, fx=240.0, fy=240.0, cx=207.5, cy=63.5)
T_A_B = from_rotation_vector(np.array([0.01, 0.08, -0.02]), np.array([0.7, 0.1, 2.0]))


class Scene:
    """Points before two cameras; ``unit`` and ``noise`` are those of the depth kept in the views."""

    def __init__(
        self, T_a_b: FloatArray = T_A_B, count: int = 200, noise: float = 0.0, unit: float = 1.0
    ) -> None:
        rng = np.random.default_rng(0)
        u, v = rng.uniform(60, 350, count), rng.uniform(20, 110, count)
        z = rng.uniform(6.0, 25.0, count)
        self.descriptors = rng.integers(0, 256, (count, 32), dtype=np.uint8)
        self.points_a = np.stack(
            [(u - CAMERA.cx) / CAMERA.fx * z, (v - CAMERA.cy) / CAMERA.fy * z, z], axis=1
        )
        self.points_b = apply(invert(T_a_b), self.points_a)
        self.rng, self.noise, self.unit = rng, noise, unit

    def view(self, index: int, points: FloatArray) -> View:
        pixels = (points / points[:, 2:]) @ CAMERA.K.T
        wrong = self.unit * np.exp(self.noise * self.rng.normal(size=(len(points), 1)))
        return View(
            index,
            pixels[:, :2].astype(np.float32),
            self.descriptors,
            (points * wrong).astype(np.float32),
        )

    def views(self) -> tuple[View, View]:
        return self.view(3, self.points_a), self.view(90, self.points_b)


def verify(earlier: View, later: View, **changes: float) -> Loop | RejectedLoop:
    return LoopVerifier(replace(OF_FRAMES, **changes), CAMERA).verify(earlier, later, 0.7)


def error(loop: Loop, T_true: FloatArray) -> tuple[float, float]:
    difference = invert(T_true) @ loop.measured.T_from_to
    return float(np.linalg.norm(difference[:3, 3])), float(
        np.rad2deg(rotation_angle(difference[:3, :3]))
    )


def test_exact_points_give_the_pose():
    loop = verify(*Scene().views())
    assert isinstance(loop, Loop) and loop.ends == (3, 90) and loop.measured.source == LOOP_SOURCE
    np.testing.assert_allclose(loop.measured.T_from_to, T_A_B, atol=1e-3)
    assert loop.inliers == 200 and loop.score == 0.7


@pytest.mark.parametrize("unit", [0.01, 1.0, 50.0])
def test_verdict_does_not_depend_on_the_unit(unit: float):
    loop = verify(*Scene(unit=unit).views())
    assert isinstance(loop, Loop)
    scaled = T_A_B.copy()
    scaled[:3, 3] *= unit
    np.testing.assert_allclose(loop.measured.T_from_to, scaled, atol=2e-3 * max(unit, 1.0))
    assert loop.measured.sigmas[3] == pytest.approx(unit * 0.085, rel=0.1)


def test_sigmas_grow_with_the_error_of_corners_and_cover_it(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(verification, "_LENGTH_RELATIVE_SIGMA", 1e-6)
    whitened, sizes = [], []
    T_a_b = from_rotation_vector(np.array([0.0, 0.05, 0.0]), np.array([0.5, 0.0, 0.0]))
    for sigma_px in (0.3, 1.0):
        for seed in range(12):
            views = Scene(T_a_b).views()
            rng = np.random.default_rng(seed)
            for view in views:
                view.pixels[:] += rng.normal(size=view.pixels.shape) * sigma_px
            loop = verify(*views)
            assert isinstance(loop, Loop)
            T_error = invert(T_a_b) @ loop.measured.T_from_to
            vee = [T_error[2, 1], T_error[0, 2], T_error[1, 0], *T_error[:3, 3]]
            whitened.append(np.array(vee) / loop.measured.sigmas)
            sizes.append(loop.measured.sigmas[0])
    assert 0.1 < np.mean(np.square(whitened)) < 1.0
    assert np.median(sizes[12:]) > 1.5 * np.median(sizes[:12])


def test_wrong_matches_are_ransac_outliers():
    earlier, later = Scene().views()
    later.pixels[:80] = np.random.default_rng(1).uniform([0, 0], [415, 127], (80, 2))
    loop = verify(earlier, later)
    assert isinstance(loop, Loop) and 115 <= loop.inliers <= 130
    assert error(loop, T_A_B)[0] < 0.05


def test_another_place_is_refused():
    earlier, later = Scene().views()
    other = np.random.default_rng(5).integers(0, 256, later.descriptors.shape, dtype=np.uint8)
    verdict = verify(earlier, View(90, later.pixels, other, later.points))
    assert isinstance(verdict, RejectedLoop) and "matches" in verdict.reason


def test_directions_that_disagree_are_refused():
    """The later image's depth is larger than the earlier one's: both directions measure different poses."""
    earlier, later = Scene(from_rotation_vector(np.zeros(3), np.array([0.0, 0.0, 5.0]))).views()
    verdict = verify(earlier, later.scaled(1.6))
    assert isinstance(verdict, RejectedLoop) and "both directions differ" in verdict.reason
    assert verdict.inliers > 100
