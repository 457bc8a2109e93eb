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

Call = Callable[..., tuple[int, str, str]]


@contextmanager
def full_disk(largest: int) -> Iterator[None]:
    """No file may grow beyond a number of bytes, whoever writes it."""
    limit, before = (
        resource.getrlimit(resource.RLIMIT_FSIZE),
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN),
    )
    resource.setrlimit(resource.RLIMIT_FSIZE, (largest, limit[1]))
    try:
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv(
                "PATH", ""
            )  # git would die of it, and leave the index of this checkout locked
            yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
        signal.signal(signal.SIGXFSZ, before)


@pytest.fixture
def run(kitti_root: Path, tiny_weights: Path, tmp_path: Path) -> list[str]:
    """A quick run."""
    words = ["run", "--dataset", str(kitti_root), "--weights", str(tiny_weights), "--frames", "0:6"]
    quick = ("visual_odometry.enabled=false", "mapping.enabled=false", "output.report=false")
    return [
        *words,
        *(word for each in quick for word in ("--set", each)),
        "--output",
        str(tmp_path / "out"),
    ]


def test_a_run_on_a_full_disk_is_one_line(run: list[str], command_line: Call, tmp_path: Path):
    with full_disk(200):
        code, _, err = command_line(slam_main, "erfsfm-slam", *run)
    said = [line for line in err.splitlines() if line.startswith("erfsfm-slam: ")]
    assert code == 1 and len(said) == 1 and "File too large" in said[0]
    assert not list((tmp_path / "out").glob("trajectory*"))
    assert command_line(slam_main, "erfsfm-slam", *run)[0] == 0


def test_a_prediction_is_whole_or_absent(
    kitti_root: Path, tiny_weights: Path, command_line: Call, tmp_path: Path
):
    images, out = kitti_root / "sequences/sim/image_2", tmp_path / "depth"
    with full_disk(200):
        assert (
            command_line(
                erfsfm_main, "erfsfm", "predict", images, "--weights", tiny_weights, "--output", out
            )[0]
            == 1
        )
    assert not list(out.iterdir())
