"""Ratios of factors within their bounds, for known noise; a run beside a GPS track."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from slam import run_slam
from slam.frames import LOOP_SOURCE, RelativePose
from slam.geometry import se3
from slam.geometry.se3 import FloatArray
from slam.results.estimate_metrics import coverage, squared_bound

SIGMAS = np.repeat([0.003, 0.03], 3)
COUNT = 3000
DRIVE = "kitti_raw/2011_09_26/2011_09_26_drive_0013_sync"


def truth() -> FloatArray:
    turns = np.tile([0.0, 0.01, 0.0], (COUNT - 1, 1))
    return se3.chain(se3.from_rotation_vector(turns, np.tile([0.0, 0.0, 1.0], (COUNT - 1, 1))))


def factors(student_t_dof: float) -> list[RelativePose]:
    """Consecutive steps, with errors by Student's t whose standard deviations are ``SIGMAS``."""
    rng, T = np.random.default_rng(0), truth()
    errors = SIGMAS * rng.normal(size=(COUNT - 1, 6))
    if not math.isinf(student_t_dof):
        errors *= np.sqrt((student_t_dof - 2) / rng.chisquare(student_t_dof, (COUNT - 1, 1)))
    measured = se3.invert(T[:-1]) @ T[1:] @ se3.from_rotation_vector(errors[:, :3], errors[:, 3:])
    return [
        RelativePose(k, k + 1, T_k, SIGMAS, "network", student_t_dof=student_t_dof)
        for k, T_k in enumerate(measured)
    ]


@pytest.mark.parametrize("student_t_dof", [math.inf, 12.0, 4.0])
def test_noise_with_the_stated_sigmas_is_covered(student_t_dof: float):
    ratios = coverage(factors(student_t_dof), truth(), 1.0)[""]
    assert ratios == {
        "50": pytest.approx(0.5, abs=0.03),
        "90": pytest.approx(0.9, abs=0.02),
        "95": pytest.approx(0.95, abs=0.02),
    }


def test_bounds_by_hand():
    assert squared_bound(0.95, math.inf) == pytest.approx(12.592, abs=1e-3)
    # the 50 % quantile of F(6, 6) is 1; four of six degrees of freedom are left of the variance
    assert squared_bound(0.5, 6.0) == pytest.approx(6 * 4 / 6)
    assert squared_bound(0.9, 1e6) == pytest.approx(squared_bound(0.9, math.inf), rel=1e-4)


def test_the_scale_is_known():
    edges, metric = factors(math.inf), truth()
    ratios = coverage(edges, metric, 1.0)
    metric[:, :3, 3] *= 4.0
    assert coverage(edges, metric, 0.25) == ratios
    assert coverage(edges, metric, 1.0)[""]["95"] < 0.1


def test_overconfident_factors_are_found_by_source():
    honest = factors(math.inf)
    boasting = [replace(f, sigmas=f.sigmas / 10, source=LOOP_SOURCE) for f in honest[:100]]
    kinds = coverage(honest + boasting, truth(), 1.0)
    assert kinds.keys() == {"", "network", LOOP_SOURCE}
    assert kinds[LOOP_SOURCE]["factors"] == 100 and kinds[LOOP_SOURCE]["95"] < 0.2
    assert kinds["network"] == {"factors": len(honest), **coverage(honest, truth(), 1.0)[""]}
    heavy = [replace(f, source="essential") for f in factors(4.0)]
    covered = coverage(
        honest + heavy, truth(), 1.0
    )  # each factor has the bound of its own distribution
    assert covered[""]["90"] == pytest.approx(
        (covered["network"]["90"] + covered["essential"]["90"]) / 2
    )


@pytest.mark.data
@pytest.mark.slow
def test_the_recorded_track_of_a_drive(data_root: Path, tmp_path: Path):
    """Fixes with 0.2 m of noise added give a metric scale without the road, and hold the heading."""
    drive = data_root / DRIVE
    begin = np.datetime64((drive / "image_02/timestamps.txt").read_text().split("\n")[0], "ns")
    times = np.array(
        (drive / "oxts/timestamps.txt").read_text().split("\n"), dtype="datetime64[ns]"
    )
    stamps = (times[~np.isnat(times)] - begin).astype(np.float64) * 1e-9
    packets = sorted((drive / "oxts/data").glob("*.txt"))
    places = np.array(
        [np.array(path.read_text().split()[:3], dtype=np.float64) for path in packets]
    )
    places += np.random.default_rng(0).normal(size=places.shape) * [0.2 / 111e3, 0.2 / 73e3, 0.2]
    table = np.column_stack([stamps, places])
    np.savetxt(
        tmp_path / "gps.csv",
        table,
        "%.10g",
        ",",
        header="stamp,latitude,longitude,altitude",
        comments="",
    )
    settings = [
        "scale.mode=gps",
        "mapping.enabled=false",
        "gps.sigma_m=0.2",
        "gps.vertical_sigma_m=0.2",
    ]
    settings.append("gps.correlation_s=0")
    folder = run_slam(
        drive, gps=tmp_path / "gps.csv", frames="0:60", overrides=settings, output=tmp_path / "run"
    )
    metrics = folder.metrics().tree()
    assert metrics["scale"]["mode"] == "gps" and metrics["gps"]["fixes"] == 59
    assert metrics["trajectories"]["optimised"]["align"]["6dof"]["ate_rmse_m"] < 0.2
    assert metrics["gps"]["optimised"]["horizontal_median_m"] < 0.3
    assert abs(metrics["gps"]["origin"]["heading_deg"] - 345) < 3
    origin = metrics["gps"]["origin"]
    assert [origin["longitude_deg"], origin["latitude_deg"]] == pytest.approx(
        [8.43781, 49.01314], abs=1e-4
    )
    assert "of the GPS track" in (folder.path / "report.html").read_text()
