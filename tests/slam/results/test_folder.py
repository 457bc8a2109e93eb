"""A run folder holds whole files or none."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from slam.errors import RunError
from slam.results.folder import RunFolder

MakeRun = Callable[..., RunFolder]


def test_new_folders_carry_the_sequence_and_latest_points_to_the_newest(tmp_path: Path) -> None:
    first = RunFolder.create(None, tmp_path / "results", "sim/loop 42")
    second = RunFolder.create(None, tmp_path / "results", "sim/loop 42")
    assert first.path != second.path
    assert first.path.name.endswith("_sim-loop-42")
    assert (tmp_path / "results" / "latest").resolve() == second.path.resolve()


def test_output_is_used_itself_and_an_old_run_in_it_is_cleared(make_run: MakeRun) -> None:
    old = make_run("mine")
    new = RunFolder.create(old.path, old.path.parent, "sim")
    assert new.path == old.path
    assert list(new.path.iterdir()) == []


def test_output_with_other_things_is_refused_and_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(RunError, match="holds no run"):
        RunFolder.create(tmp_path, tmp_path, "sim")
    assert (tmp_path / "thesis.tex").read_text() == "years of work"


@pytest.mark.parametrize(("name", "why"), [("nowhere", "no such folder"), (".", "no metrics.json")])
def test_open_says_what_is_wrong(tmp_path: Path, name: str, why: str) -> None:
    with pytest.raises(RunError, match=why):
        RunFolder.open(tmp_path / name)


def test_a_write_that_fails_leaves_the_old_file_and_no_rest(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    folder.write_text("run.log", "old")

    def fail(path: Path) -> None:
        path.write_text("half")
        raise OSError("disk full")

    with pytest.raises(RunError, match="disk full"):
        folder.write("run.log", fail)
    assert [path.name for path in tmp_path.iterdir()] == ["run.log"]
    assert (tmp_path / "run.log").read_text() == "old"


def test_metrics_survive_a_round_trip_and_refuse_nan(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    folder.write_metrics({"status": "ok", "name": "é"})
    assert RunFolder.open(tmp_path).metrics() == {"status": "ok", "name": "é"}
    with pytest.raises(ValueError, match="JSON"):
        folder.write_metrics({"ate": float("nan")})
    assert json.loads((tmp_path / "metrics.json").read_text())["status"] == "ok"


def test_damaged_metrics_are_one_clear_error(tmp_path: Path) -> None:
    (tmp_path / "metrics.json").write_text('{"status": ')
    with pytest.raises(RunError, match="is damaged"):
        RunFolder.open(tmp_path).metrics()


def test_trajectories_survive_a_round_trip(make_run: MakeRun) -> None:
    folder = make_run()
    optimised = folder.trajectory("optimised")
    assert optimised is not None
    assert len(optimised) == 300
    np.testing.assert_allclose(optimised.T_world_camera[0], np.eye(4), atol=1e-9)
    assert folder.trajectory("lidar") is None
    assert folder.trajectory("reference") is not None


def test_require_names_what_there_is(make_run: MakeRun) -> None:
    folder = make_run()
    assert folder.require("graph.g2o").is_file()
    with pytest.raises(RunError, match=r"has no map\.las: it holds .*graph\.g2o"):
        folder.require("map.las")
