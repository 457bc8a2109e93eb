"""A run folder holds whole files or none; its log is complete from the first line, and never ends the run."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

import slam
from slam.results.folder import RunFolder, run_log
from slam.results.metrics import MapMetrics, Metrics, Provenance
from slam.runtime.errors import Failed, RunError

MakeRun = Callable[..., RunFolder]
LOGGER = logging.getLogger("slam.test")


def test_a_folder_that_is_not_there_is_said(tmp_path: Path):
    with pytest.raises(RunError, match="nowhere is not there"):
        RunFolder(tmp_path / "nowhere")


def test_new_folders_carry_the_sequence_and_latest_points_to_the_newest(tmp_path: Path):
    first = RunFolder.create(None, tmp_path / "results", "sim/loop 42")
    second = RunFolder.create(None, tmp_path / "results", "sim/loop 42")
    assert first.path != second.path
    assert first.path.name.endswith("_sim-loop-42")
    assert (tmp_path / "results" / "latest").resolve() == second.path.resolve()


def begin(output: Path) -> RunFolder:
    """A new run into ``output``, before it has a trajectory."""
    folder = RunFolder.create(output, output.parent, "sim")
    folder.write_metrics(
        Metrics(schema_=1, status="running", provenance=Provenance(weights_sha256="00"))
    )
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def test_a_new_run_replaces_the_files_of_an_earlier_one_alone(make_run: MakeRun):
    old = make_run("mine").path
    (old / "notes.txt").write_text("what I saw")
    assert begin(old).path == old
    assert {path.name for path in old.iterdir()} == {"metrics.json", "notes.txt"}


def test_what_a_killed_run_was_writing_goes_with_it(tmp_path: Path):
    begin(tmp_path / "mine")
    (tmp_path / "mine" / ".12.34.partial.map_mesh.ply").write_text("ply")
    (tmp_path / "mine" / ".12.34.partial.thesis.tex").write_text("of somebody else")
    new = RunFolder.create(tmp_path / "mine", tmp_path, "sim")
    assert new.path == tmp_path / "mine"
    assert [path.name for path in new.path.iterdir()] == [".12.34.partial.thesis.tex"]


def test_runs_that_begin_in_the_same_second_get_a_folder_each(tmp_path: Path):
    with ThreadPoolExecutor(8) as pool:
        folders = list(pool.map(lambda _: RunFolder.create(None, tmp_path, "sim").path, range(32)))
    assert len(set(folders)) == 32 and all(path.is_dir() for path in folders)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("config.yaml", "mine: true"),
        ("metrics.json", '{"accuracy": 0.9}'),
        ("metrics.json", '{"schema": 1, "status": "ok", "provenance": {"tool": "another"}}'),
    ],
)
def test_files_of_other_programs_are_not_replaced(tmp_path: Path, name: str, text: str):
    (tmp_path / name).write_text(text)
    with pytest.raises(
        RunError, match=r"not empty and holds no run of erfsfm-slam: choose another --output"
    ):
        RunFolder.create(tmp_path, tmp_path, "sim")
    assert contents(tmp_path) == {name: text.encode()}


def test_a_run_that_did_not_end_is_opened_with_one_note(
    make_run: MakeRun, caplog: pytest.LogCaptureFixture
):
    folder = make_run()
    RunFolder.open(folder.path)
    assert caplog.records == []
    failed = {
        "schema": 1,
        "status": "failed",
        "reason": "no space",
        "provenance": {"weights_sha256": "00"},
    }
    folder.write_metrics(Metrics.model_validate(failed))
    RunFolder.open(folder.path)
    assert [record.getMessage() for record in caplog.records] == [
        f"{folder.path}: no space: files that are there are whole"
    ]
    (folder.path / "metrics.json").unlink()
    assert RunFolder.open(folder.path).metrics().tree()["status"] == "running"


@pytest.mark.parametrize(
    "reason",
    ["the map is empty: no depth passed the filters", "fusion is switched off (mapping.enabled)"],
)
def test_a_missing_map_is_explained_by_the_run(make_run: MakeRun, reason: str):
    folder = make_run()
    (folder.path / "map_mesh.ply").unlink()
    folder.write_metrics(folder.metrics().changed(map=MapMetrics.unknown(reason)))
    with pytest.raises(RunError, match=re.escape(f"has no map_mesh.ply: {reason}")):
        folder.require("map_mesh.ply")
    folder.write_metrics(
        folder.metrics().changed(map=Failed("the run ended before its map was whole"))
    )
    with pytest.raises(
        RunError, match=r"has no map_mesh\.ply: the run ended before its map was whole"
    ):
        folder.require("map_mesh.ply")


def test_a_run_opens_by_its_name_and_shows_itself(make_run: MakeRun):
    path = make_run("mine").path
    run = slam.RunFolder(str(path))
    assert run.path == path and len(run.mesh().vertices) == 3
    shown = run._repr_html_()
    assert "7dof" in shown and "<td>optimised</td>" in shown and "<script" not in shown
    (path / "map_mesh.ply").unlink()
    with pytest.raises(RunError, match=r"has no map_mesh\.ply"):
        run.mesh()


def test_lines_from_before_the_folder_are_kept_and_failures_are_written_here_alone(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    with run_log() as log:
        LOGGER.info("checked")
        log.begin(tmp_path / "run.log")
        for frame in range(9):
            LOGGER.info("frame %d failed: %s", frame, "no road")
        log.failed("no space")
    LOGGER.warning("after it")
    lines = (tmp_path / "run.log").read_text().splitlines()
    assert [line.split(" ", 2)[2] for line in lines] == [
        "INFO slam.test: checked",
        "INFO slam.test: frame 0 failed: no road",
        "ERROR slam.commands.run: the run failed: no space",
        "INFO slam.commands.run: 9 times: no road",
    ]
    assert "no space" not in caplog.text


def test_a_trajectory_by_a_name_that_there_is_not_is_told_which_there_are(
    make_run: Callable[..., RunFolder],
):
    with pytest.raises(
        RunError, match=r"trajectory optimized: give reference, network, .*optimised"
    ):
        make_run().trajectory("optimized")
    assert make_run("other").trajectory("lidar") is None
