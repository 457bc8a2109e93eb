"""A run beside a GPS track: metrics and report, with the recorded track of a KITTI drive."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from slam import run_slam

DRIVE = "kitti_raw/2011_09_26/2011_09_26_drive_0013_sync"


@pytest.mark.data
@pytest.mark.slow
def test_the_recorded_track_of_a_drive(data_root: Path, tmp_path: Path) -> None:
    """Fixes with 0.2 m of noise added give a metric scale without the road, and hold the heading."""
    drive = data_root / DRIVE
    begin = np.datetime64((drive / "image_02/timestamps.txt").read_text().split("\n")[0], "ns")
    times = np.array((drive / "oxts/timestamps.txt").read_text().split("\n"), dtype="datetime64[ns]")
    stamps = (times[~np.isnat(times)] - begin).astype(np.float64) * 1e-9
    packets = sorted((drive / "oxts/data").glob("*.txt"))
    places = np.array([np.array(path.read_text().split()[:3], dtype=np.float64) for path in packets])
    places += np.random.default_rng(0).normal(size=places.shape) * [0.2 / 111e3, 0.2 / 73e3, 0.2]
    table = np.column_stack([stamps, places])
    np.savetxt(tmp_path / "gps.csv", table, "%.10g", ",", header="stamp,latitude,longitude,altitude", comments="")
    settings = ["scale.mode=gps", "mapping.enabled=false", "gps.sigma_m=0.2", "gps.vertical_sigma_m=0.2"]
    settings.append("gps.correlation_s=0")
    folder = run_slam(drive, gps=tmp_path / "gps.csv", frames="0:60", overrides=settings, output=tmp_path / "run")
    metrics = folder.metrics().tree()
    assert metrics["scale"]["mode"] == "gps" and metrics["gps"]["fixes"] == 59
    assert metrics["trajectories"]["optimised"]["align"]["6dof"]["ate_rmse_m"] < 0.2
    assert metrics["gps"]["optimised"]["horizontal_median_m"] < 0.3
    assert abs(metrics["gps"]["origin"]["heading_deg"] - 345) < 3
    origin = metrics["gps"]["origin"]
    assert [origin["longitude_deg"], origin["latitude_deg"]] == pytest.approx([8.43781, 49.01314], abs=1e-4)
    assert "of the GPS track" in (folder.path / "report.html").read_text()
