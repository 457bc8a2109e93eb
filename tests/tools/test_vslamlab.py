"""The entry point for VSLAM-LAB on a sequence in its layout; VSLAM-LAB itself is not here."""

from __future__ import annotations

import csv
import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

ENTRY = Path(__file__).parents[2] / "tools" / "vslamlab" / "vslamlab_erfsfm_mono.py"
BEGIN_NS, STEP_NS = 1_403_715_273_262_142_976, 100_000_000


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated street as VSLAM-LAB stores one, with the whole nanoseconds of a clock."""
    here = tmp_path_factory.mktemp("vslamlab")
    world, folder = here / "world", here / "sequence"
    words = ["--route", "straight", "--width", "208", "--height", "64", "--frames", "8", "--seed", "1"]
    subprocess.run([sys.executable, "-m", "slam", "simulate", str(world), *words], check=True, capture_output=True)
    folder.mkdir()
    (world / "sequences" / "sim" / "image_2").rename(folder / "rgb_0")
    names = sorted(path.name for path in (folder / "rgb_0").glob("*.png"))
    rows = [f"{BEGIN_NS + STEP_NS * k},rgb_0/{name}\n" for k, name in enumerate(names)]
    (folder / "rgb.csv").write_text("ts_rgb_0 (ns),path_rgb_0\n" + "".join(rows))
    ours = yaml.safe_load((world / "camera.yaml").read_text())
    camera = {"cam_name": "rgb_0", "cam_type": "rgb", "cam_model": "pinhole", "fps": 10.0}
    camera |= {"focal_length": [ours["fx"], ours["fy"]], "principal_point": [ours["cx"], ours["cy"]]}
    camera |= {"image_dimension": [ours["width"], ours["height"]], "distortion_type": "radtan4"}
    camera["distortion_coefficients"] = [0.0, 0.0, 0.0, 0.0]
    (folder / "calibration.yaml").write_text("%YAML 1.2\n---\n" + yaml.safe_dump({"cameras": [camera]}))
    return folder


def run(sequence: Path, calibration: Path, experiment: Path, monkeypatch: pytest.MonkeyPatch, *more: str) -> None:
    files = [f"--calibration_yaml={calibration}", f"--rgb_csv={sequence / 'rgb.csv'}"]
    words = [f"--sequence_path={sequence}", *files, f"--exp_folder={experiment}", "--exp_it", "3"]
    words += ["--settings_yaml", "none.yaml", "--verbose", "1", "--mode", "mono"]  # what VSLAM-LAB passes to everyone
    monkeypatch.setattr(sys, "argv", [str(ENTRY), *words, "--overrides", "mapping.enabled=false", *more])
    runpy.run_path(str(ENTRY), run_name="__main__")


def test_every_frame_has_its_own_stamp_and_pose(
    sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run(sequence, sequence / "calibration.yaml", tmp_path, monkeypatch, "--camera_height_m", "1.65")
    head, *rows = csv.reader((tmp_path / "00003_KeyFrameTrajectory.csv").open())
    assert head == ["ts (ns)", "tx (m)", "ty (m)", "tz (m)", "qx", "qy", "qz", "qw"]
    assert [int(row[0]) for row in rows] == [BEGIN_NS + STEP_NS * k for k in range(8)]
    positions = np.array(rows)[:, 1:4].astype(float)
    truth = np.loadtxt(sequence.parent / "world" / "poses" / "sim.txt").reshape(-1, 3, 4)[:, :, 3]
    assert np.abs(positions - (truth - truth[0])).max() < 1.0  # metres, of a path of 8


def test_another_camera_is_refused_in_one_line(sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "calibration.yaml"
    path.write_text((sequence / "calibration.yaml").read_text().replace("radtan4", "fov1"))
    with pytest.raises(SystemExit, match="the distortion fov1 is not known here, only radtan4, radtan5, equid4"):
        run(sequence, path, tmp_path, monkeypatch)
