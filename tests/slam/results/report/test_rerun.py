"""A recording for the viewer where rerun is installed; else one line with how to install it."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slam import run_slam
from slam.runtime.errors import SlamError


@pytest.fixture
def quick(kitti_root: Path, tiny_weights: Path, tmp_path: Path) -> dict[str, Any]:
    overrides = ["visual_odometry.enabled=false", "output.report=false"]
    return {
        "dataset": kitti_root,
        "weights": tiny_weights,
        "overrides": overrides,
        "output": tmp_path / "run",
    }


def test_without_rerun_the_run_does_not_begin(
    quick: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    find = importlib.import_module

    def absent(name: str, *rest: Any) -> Any:
        if name == "rerun":
            raise ModuleNotFoundError("No module named 'rerun'")
        return find(name, *rest)

    monkeypatch.setattr(importlib, "import_module", absent)
    with pytest.raises(
        SlamError, match=r"^--rerun and --view need rerun .*'erfsfm-slam\[rerun\]'"
    ) as refused:
        run_slam(**quick, rerun=tmp_path / "run.rrd")
    assert "\n" not in str(refused.value) and list(tmp_path.iterdir()) == []


class Recorder:
    """In place of the SDK: records what is logged where."""

    def __init__(self) -> None:
        self.logged: list[tuple[str, str, int | None]] = []
        self.frame: int | None = None
        self.ViewCoordinates = type("ViewCoordinates", (), {"RDF": self.part("RDF")()})
        for name in ("LineStrips3D", "Transform3D", "Pinhole", "Image", "DepthImage", "Points3D"):
            setattr(self, name, self.part(name))

    def part(self, kind: str) -> Any:
        def made(*arguments: Any, **options: Any) -> Any:
            return type(
                kind, (), {"arguments": arguments, "options": options, "compress": lambda s, **_: s}
            )()

        return made

    def RecordingStream(self, name: str) -> Recorder:
        return self

    def save(self, path: str) -> None:
        Path(path).write_bytes(b"RRF2")

    def set_time(
        self, timeline: str, sequence: int | None = None, duration: float | None = None
    ) -> None:
        self.frame = sequence if timeline == "frame" else self.frame

    def log(self, place: str, what: Any, static: bool = False) -> None:
        if type(what).__name__ == "LineStrips3D":
            assert np.shape(what.arguments[0]) == (1, 14, 3)
        self.logged.append((place, type(what).__name__, None if static else self.frame))

    def flush(self) -> None:
        pass

    def disconnect(self) -> None:
        pass


def test_everything_is_logged(
    quick: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    recorder = Recorder()
    for module in ("slam.commands.run", "slam.results.report.rerun"):
        monkeypatch.setattr(f"{module}.import_extra", lambda extra: (recorder,))
    run_slam(**quick, rerun=tmp_path / "deep" / "run.rrd")
    assert (tmp_path / "deep" / "run.rrd").read_bytes() == b"RRF2"
    static = {place for place, _, frame in recorder.logged if frame is None}
    assert static >= {"world", "world/odometry", "world/optimised", "world/reference"}
    for kind in ("Transform3D", "Pinhole", "Image", "DepthImage"):
        assert [frame for _, what, frame in recorder.logged if what == kind] == list(range(14))


def test_rerun_itself_reads_it(quick: dict[str, Any], tmp_path: Path):
    pytest.importorskip("rerun", reason="the extra rerun is not installed")
    run_slam(**quick, rerun=tmp_path / "run.rrd")
    content = (tmp_path / "run.rrd").read_bytes()
    assert content[:3] == b"RRF" and len(content) > 50_000
    for place in (b"/world/optimised", b"/world/camera/image/depth"):
        assert place in content
