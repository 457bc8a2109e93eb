"""A whole run without a cache, with a cold and with a warm one: the same bytes, and no network runs twice."""

from __future__ import annotations

import zipfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from slam import run_slam
from slam.results.folder import RunFolder

# hold the time and duration of the run
DIFFERENT = {"metrics.json", "run.log", "report.html"}
NETWORKS = ("disparity", "poses")


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """Number of calls of networks, which are otherwise unchanged."""
    from erfsfm.inference import DepthPosePredictor

    counts: Counter[str] = Counter()

    def count(owner: Any, name: str) -> None:
        real: Callable[..., Any] = getattr(owner, name)

        def counting(*arguments: Any, **options: Any) -> Any:
            counts[name] += 1
            return real(*arguments, **options)

        monkeypatch.setattr(owner, name, counting)

    for name in NETWORKS:
        count(DepthPosePredictor, name)
    return counts


def contents(run: RunFolder) -> dict[str, bytes]:
    """Bytes of each file of a run; of an archive those of its members, without the time of their writing."""
    found = {}
    for path in run.path.iterdir():
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as archive:
                found |= {f"{path.name}/{name}": archive.read(name) for name in archive.namelist()}
        elif path.name not in DIFFERENT:
            found[path.name] = path.read_bytes()
    return found


@pytest.mark.slow
def test_a_warm_cache_runs_no_network_and_leaves_the_same_bytes(tmp_path: Path, calls: Counter[str]) -> None:
    cache = tmp_path / "cache"
    files: dict[str, dict[str, bytes]] = {}
    computed: dict[str, Counter[str]] = {}
    for name, where in (("none", None), ("cold", cache), ("warm", cache)):
        calls.clear()
        files[name] = contents(run_slam(weights="sim", frames="20:45", output=tmp_path / name, cache=where))
        computed[name] = calls.copy()
    for name in ("none", "cold"):
        assert all(computed[name][each] > 0 for each in NETWORKS), computed[name]
    assert not computed["warm"]
    assert {"trajectory_optimised.kitti.txt", "graph.g2o", "map_mesh.ply", "loops.json"} <= files["none"].keys()
    for name in ("cold", "warm"):
        assert files[name].keys() == files["none"].keys()
        assert [file for file in files["none"] if files[name][file] != files["none"][file]] == []
