"""A disk that is full: one line, exit 1, and no file lost or cut under its name."""

from __future__ import annotations

import resource
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from erfsfm.cli import main as erfsfm_main
from slam.commands.cli import main as slam_main

Call = Callable[[Callable[[], None], list[str]], int]


@contextmanager
def full_disk(largest: int) -> Iterator[None]:
    """No file may grow beyond a number of bytes, whoever writes it."""
    limit, before = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (largest, limit[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
        signal.signal(signal.SIGXFSZ, before)


@pytest.fixture
def run(kitti_root: Path, tiny_weights: Path, tmp_path: Path) -> list[str]:
    """A quick run."""
    words = ["run", "--dataset", str(kitti_root), "--weights", str(tiny_weights), "--frames", "0:6"]
    quick = ("visual_odometry.enabled=false", "mapping.enabled=false", "output.report=false")
    return [*words, *(word for each in quick for word in ("--set", each)), "--output", str(tmp_path / "out")]


def test_a_run_on_a_full_disk_is_one_line(
    run: list[str], call: Call, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with full_disk(200):
        assert call(slam_main, run) == 1
    said = [line for line in capfd.readouterr().err.splitlines() if line.startswith("erfsfm-slam: ")]
    assert len(said) == 1 and "File too large" in said[0]
    assert not list((tmp_path / "out").glob("trajectory*")) and call(slam_main, run) == 0


def test_a_prediction_is_whole_or_absent(
    kitti_root: Path, tiny_weights: Path, call: Call, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    images, out = kitti_root / "sequences/sim/image_2", tmp_path / "depth"
    with full_disk(200):
        assert call(erfsfm_main, ["predict", str(images), "--weights", str(tiny_weights), "--output", str(out)]) == 1
    assert "Traceback" not in capfd.readouterr().err
    assert not list(out.iterdir())
