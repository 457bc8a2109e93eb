"""Data types shared by the parts."""

from __future__ import annotations

import cv2
import numpy as np

from slam.frames import Frame, Intrinsics, RelativePose


def test_rays_project_back_to_their_pixels():
    camera = Intrinsics(40, 30, 50.0, 55.0, 19.5, 14.0)
    grid = camera.pixel_grid()
    rays = camera.rays(grid)
    assert grid.shape == (30, 40, 2) and rays.shape == (30, 40, 3)
    np.testing.assert_allclose((rays @ camera.K.T)[..., :2], grid, atol=1e-12)
    assert (rays[..., 2] == 1.0).all()


def image(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 255, (30, 40, 3), np.uint8)


def test_grey_levels_are_made_once_a_frame():
    frame = Frame(3, 0.3, image())
    np.testing.assert_array_equal(frame.grey, cv2.cvtColor(image(), cv2.COLOR_RGB2GRAY))
    assert frame.grey is frame.grey


def test_what_is_derived_from_a_frame_is_kept_by_its_key():
    frame = Frame(0, 0.0, image())
    made: list[str] = []

    def make(name: str) -> str:
        made.append(name)
        return name

    assert [frame.derived(("layers", k), lambda k=k: make(f"layers {k}")) for k in (1, 2, 1)] == [
        "layers 1",
        "layers 2",
        "layers 1",
    ]
    assert made == ["layers 1", "layers 2"]
    assert (
        Frame(0, 0.0, image()).derived(("layers", 1), lambda: "of another frame")
        == "of another frame"
    )


def test_a_relative_pose_in_another_unit_has_other_lengths_only():
    T = np.eye(4)
    T[:3, 3] = [1.0, 2.0, 3.0]
    measured = RelativePose(3, 4, T, np.arange(1.0, 7.0), "network", np.arange(2.0, 8.0), 4.0)
    metric = measured.scaled(2.0)
    np.testing.assert_array_equal(metric.T_from_to[:3, 3], [2.0, 4.0, 6.0])
    np.testing.assert_array_equal(metric.sigmas, [1, 2, 3, 8, 10, 12])
    np.testing.assert_array_equal(metric.graph_sigmas, [2, 3, 4, 10, 12, 14])
    np.testing.assert_array_equal(measured.T_from_to[:3, 3], [1.0, 2.0, 3.0])
    assert (metric.ends, metric.source, metric.student_t_dof) == ((3, 4), "network", 4.0)
    uncorrelated = RelativePose(3, 4, T, np.arange(1.0, 7.0), "network").scaled(2.0)
    assert uncorrelated.correlated_sigmas is None
    np.testing.assert_array_equal(uncorrelated.graph_sigmas, uncorrelated.sigmas)
