"""Figures have the right content and are written whole."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.image import imread
from numpy.typing import NDArray

from slam.evaluation.drift import aligned, segment_drifts
from slam.formats.trajectory import Trajectory
from slam.geometry.se3 import Similarity, from_rotation_vector
from slam.results.folder import RunFolder
from slam.results.report.plots import (
    depth_figure,
    plot_runs,
    trajectories_figure,
    trajectories_of,
)
from slam.runtime.errors import RunError

MakeRun = Callable[..., RunFolder]


def drawn(figure: Any) -> NDArray[np.floating]:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=60)
    buffer.seek(0)
    return imread(buffer)


def is_blank(picture: NDArray[np.floating]) -> bool:
    return bool(picture[..., :3].std() < 0.02)


def moved(trajectory: Trajectory, scale: float) -> Trajectory:
    """The same motion in another world and unit."""
    T_other_world = from_rotation_vector(np.array([0.3, -0.5, 0.2]), np.array([4.0, 5.0, 6.0]))
    similarity = Similarity(scale, T_other_world[:3, :3], T_other_world[:3, 3])
    return Trajectory(trajectory.stamps, similarity.apply_to_poses(trajectory.T_world_camera))


@pytest.mark.parametrize("what", ["trajectory", "errors", "drift"])
def test_figures_of_a_run_are_not_blank_and_change_no_global_state(make_run: MakeRun, what: str) -> None:
    before = dict(mpl.rcParams)
    figure = trajectories_figure(what, trajectories_of(make_run()), "sim")
    assert not is_blank(drawn(figure))
    assert dict(mpl.rcParams) == before


def test_without_a_reference_nothing_is_aligned_and_the_unit_is_shown(make_run: MakeRun) -> None:
    trajectories = trajectories_of(make_run(reference=False))
    (axes,) = trajectories_figure("trajectory", trajectories, unit="camera heights").axes
    assert "camera heights" in axes.get_xlabel()
    assert axes.get_legend().get_title().get_text() == ""
    optimised = next(line for line in axes.get_lines() if line.get_label() == "Optimised")
    np.testing.assert_allclose(optimised.get_ydata(), trajectories["optimised"].positions[:, 2])


def test_alignment_removes_a_similarity_and_drift_is_then_zero(make_run: MakeRun) -> None:
    reference = trajectories_of(make_run())["reference"]
    fitted = aligned({"reference": reference, "optimised": moved(reference, 0.2)})["optimised"]
    np.testing.assert_allclose(fitted.positions, reference.positions, atol=1e-5)
    drifts = segment_drifts(fitted, reference)
    assert [drift.length_m for drift in drifts] == [10.0, 20.0, 50.0, 100.0, 200.0]
    assert max(drift.translation for drift in drifts) < 1e-5
    assert max(drift.rotation for drift in drifts) < 1e-5


def test_drift_of_a_known_scale_and_rotation_has_its_hand_value() -> None:
    frames = 121
    T_true = np.tile(np.eye(4), (frames, 1, 1))
    T_true[:, 2, 3] = np.arange(frames)
    T_estimate = T_true.copy()
    T_estimate[:, 2, 3] *= 1.05
    stamps = np.arange(frames, dtype=np.float64)
    drifts = segment_drifts(Trajectory(stamps, T_estimate), Trajectory(stamps, T_true))
    # a segment ends with the first frame beyond its length, KITTI's rule: 11 m for 10 m
    assert drifts[0].translation == pytest.approx(0.05 * 11 / 10)
    assert drifts[0].rotation == 0.0


def test_errors_need_a_reference(make_run: MakeRun, tmp_path: Path) -> None:
    run = make_run(reference=False)
    with pytest.raises(RunError, match="no reference"):
        trajectories_figure("errors", trajectories_of(run))
    with pytest.raises(RunError, match=r"has no reference.*plot --what trajectory"):
        plot_runs([run], ["errors"], tmp_path / "a.png")
    plot_runs([run], ["trajectory"], tmp_path / "a.png")
    with pytest.raises(RunError, match="60 runs are wider than a page"):
        plot_runs([run] * 60, ["trajectory"], tmp_path / "a.png")


@pytest.mark.parametrize(("suffix", "start"), [("png", b"\x89PNG"), ("PDF", b"%PDF"), ("svg", b"<?xml")])
def test_figures_are_written_in_every_format(make_run: MakeRun, tmp_path: Path, suffix: str, start: bytes) -> None:
    output = tmp_path / "out" / f"figure.{suffix}"
    plot_runs([make_run("one"), make_run("two")], ["trajectory", "errors", "drift"], output)
    content = output.read_bytes()
    assert content.startswith(start)
    assert b"CreationDate" not in content
    assert b"dc:date" not in content
    assert [path.name for path in output.parent.iterdir()] == [output.name]
    if suffix == "png":
        picture = imread(output)
        assert picture.shape[1] > picture.shape[0]
        assert not is_blank(picture)


def test_depth_figure_shows_near_bright_and_unknown_grey() -> None:
    image = np.full((40, 120, 3), 128, dtype=np.uint8)
    depth = np.full((40, 120), 50.0, dtype=np.float32)
    depth[:, :40], depth[:, 80:] = 2.0, 0.0
    figure = depth_figure([image] * 4, [depth] * 4, [f"frame {k}" for k in range(4)])
    shown = figure.axes[3].images[0]
    near, far, unknown = (shown.to_rgba(shown.get_array())[20, column, :3] for column in (10, 60, 110))
    assert near.mean() > far.mean() + 0.3
    assert np.ptp(unknown) < 0.1
    assert not is_blank(drawn(figure))
