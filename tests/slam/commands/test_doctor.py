"""The doctor lists what is installed, what is missing, and what to do."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from slam.commands import doctor
from slam.commands.doctor import examine


@pytest.fixture(autouse=True)
def _no_data_set(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("KITTI_ODOMETRY", raising=False)


def finding(lines: list[str], word: str) -> str:
    (line,) = [line for line in lines if word in line]
    return line


def test_every_line_is_ok_or_missing():
    lines = examine(None)
    assert all(line.split()[0] in ("ok", "missing") and "\n" not in line for line in lines)
    for name in ("python", "torch", "gtsam", "kiss-icp", "evo", "opencv-python-headless", "open3d"):
        assert finding(lines, f" {name} ").startswith("ok")
    assert finding(lines, "KITTI_ODOMETRY").startswith("missing")


def test_packages_that_take_seconds_are_not_imported():
    program = (
        "import sys; from slam.commands.doctor import examine; examine(None); "
        "print(*{'torch', 'lightning', 'evo', 'matplotlib', 'dash'} & set(sys.modules))"
    )
    finished = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert finished.stdout.split() == []


def test_weights_are_named_with_their_licence(monkeypatch: pytest.MonkeyPatch, tiny_weights: Path):
    monkeypatch.setattr(doctor, "WEIGHTS", ("nowhere", str(tiny_weights)))
    lines = examine(None)
    assert finding(lines, "weights nowhere").startswith("missing")
    line = finding(lines, f"weights {tiny_weights}")
    assert line.startswith("ok") and "depthnet and posenet" in line and "none, untrained" in line


@pytest.mark.parametrize("how", ["IMPORTED", "LOOKED_UP"])
def test_a_missing_package_comes_with_its_installation(monkeypatch: pytest.MonkeyPatch, how: str):
    monkeypatch.setattr(doctor, how, {"no-such-package": "no_such_package"})
    line = finding(examine(None), "no-such-package:")
    assert line.startswith("missing") and "pip install" in line


@pytest.mark.parametrize("by_variable", [False, True])
def test_a_data_set_sequence_by_sequence(
    kitti_root: Path, by_variable: bool, monkeypatch: pytest.MonkeyPatch
):
    if by_variable:
        monkeypatch.setenv("KITTI_ODOMETRY", str(kitti_root))
    line = finding(examine(None if by_variable else kitti_root), "sequence sim")
    assert line.startswith("ok") and "14 frames of 208x64, true poses, camera 1.54 m high" in line


def test_a_sequence_that_cannot_be_opened_says_why(copy_of_kitti_root: Callable[[], Path]):
    root = copy_of_kitti_root()
    (root / "sequences" / "sim" / "calib.txt").unlink()
    line = finding(examine(root), "sequence sim")
    assert line.startswith("missing") and "calib.txt" in line
