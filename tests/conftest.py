"""Fixtures of every test: a quiet, repeatable environment, the folder of real recordings, a check of run folders, a few
frames of the simulated street on disk, and untrained networks."""

from __future__ import annotations

import gc
import json
import os
import random
import shutil
import signal
import sys
import tempfile
from collections.abc import Callable, Generator, Mapping
from pathlib import Path
from typing import Any

# Read when NumPy and torch are first imported, so before any test module: one thread, and none that spins.
os.environ["OMP_WAIT_POLICY"] = "PASSIVE"
for _threads in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[_threads] = "1"
os.environ["MPLBACKEND"] = "Agg"
# The font cache is costly to build: it outlives the session, unlike the home folder below.
os.environ.setdefault(
    "MPLCONFIGDIR", str(Path(tempfile.gettempdir()) / f"erfsfm-slam-matplotlib-{os.getuid()}")
)

# Torch and two thousand tests stay for the session: no collection of garbage looks through them again.
gc.disable()

import numpy as np  # noqa: E402
import pytest  # noqa: E402

import erfsfm  # noqa: E402, F401  before any test module loads OpenCV, which then reads the largest image from it


def pytest_collection_finish():
    """All that is imported and collected leaves the heap that is searched for garbage."""
    gc.freeze()
    gc.enable()


@pytest.fixture
def as_in_the_foreground() -> Generator[None]:
    """What a shell starts in the background ignores SIGINT; nohup ignores SIGHUP."""
    before = {
        number: signal.signal(number, signal.SIG_DFL) for number in (signal.SIGTERM, signal.SIGHUP)
    }
    before[signal.SIGINT] = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture(scope="session", autouse=True)
def _separate_home(tmp_path_factory: pytest.TempPathFactory):
    """Keep evo and others from leaving settings in the user's home."""
    os.environ["HOME"] = str(tmp_path_factory.mktemp("home"))


@pytest.fixture(scope="session", autouse=True)
def _signals_as_in_a_terminal():
    """Tests that are started with nohup inherit an ignored SIGHUP."""
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


@pytest.fixture(autouse=True)
def _seeded():
    """The same random seeds in every test; torch only where a test has loaded it."""
    random.seed(0)
    np.random.seed(0)
    if "torch" in sys.modules:
        sys.modules["torch"].manual_seed(0)


@pytest.fixture
def command_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., tuple[int, str, str]]:
    """Exit code, stdout and stderr of a program with these words, in this process: ``command_line(main, *words)``."""

    def call(main: Callable[[], None], *words: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", list(map(str, words)))
        capsys.readouterr()
        with pytest.raises(SystemExit) as stopped:
            main()
        out, err = capsys.readouterr()
        assert "Traceback" not in err
        return int(stopped.value.code or 0), out, err

    return call


@pytest.fixture(scope="session")
def data_root() -> Path:
    """The folder of real recordings: $ERFSFM_DATA, or ``shared/data`` beside the repository."""
    root = Path(os.environ.get("ERFSFM_DATA") or Path(__file__).parents[2] / "shared" / "data")
    if not root.is_dir():
        pytest.skip(f"no real recordings in {root}; set ERFSFM_DATA to their folder")
    return root


_A = dict.fromkeys(
    (
        "ate_rmse_m",
        "t_rel_percent",
        "r_rel_deg_per_100m",
        "rpe_trans_m",
        "rpe_trans_rmse_m",
        "rpe_rot_deg",
        "rpe_rot_rmse_deg",
        "scale",
    ),
    float,
)
_T = {
    "snippet5": {
        **dict.fromkeys(("ate_mean", "ate_std", "re_mean", "re_std"), float),
        "count": int,
    },
    "align": dict.fromkeys(("none", "first", "scale", "6dof", "7dof"), _A),
    "evo": dict.fromkeys(("ape_rmse_m_7dof", "rpe_trans_m", "rpe_rot_deg", "difference"), float),
}
_WEIGHTS = ("weights", "weights_sha256", "weights_licence", "depth_source", "depth_sha256")
_WORDS = ("version", "commit", "command", "device", *_WEIGHTS)
_PROVENANCE = {**dict.fromkeys(_WORDS, str), "seed": int, "trained_on": list, "leak": bool}
_AT = dict.fromkeys(("0.2", "0.5"), float)
_MAP_ERRORS = {
    **dict.fromkeys(("accuracy_median_m", "accuracy_90_m", "outlier_share", "completeness"), float),
    **dict.fromkeys(("f_score", "precision", "recall"), _AT),
}
# metrics.json of a run that ended well: design, section 7
_METRICS = {
    "schema": int,
    "status": str,
    "provenance": _PROVENANCE,
    "sequence": {"name": str, "frames": int, "length_m": float, "fps": float},
    "timing": {
        **dict.fromkeys(
            ("seconds_total", "frames_per_second", "cpu_seconds", "peak_rss_mb"), float
        ),
        "stages": dict,
    },
    "scale": {"mode": str, "value": float},
    "trajectories": dict.fromkeys(("network", "odometry", "optimised", "lidar"), _T),
    "graph": {"nodes": int, "factors": int, "coverage": dict.fromkeys(("50", "90", "95"), float)},
    "loops": {**dict.fromkeys(("candidates", "verified", "accepted"), int), "rejected": list},
    "map": {
        **dict.fromkeys(("triangles", "points", "blocks", "submaps"), int),
        **{"filters": dict, "floater_share": float, "double_wall_share": float},
        **_MAP_ERRORS,
        **{"in_field": dict, "by_distance": list, "truth": str, "evaluated_m": float},
        "with_scale": {"scale": float, **_MAP_ERRORS},
    },
}
# never null
_ALWAYS = {
    "schema",
    "status",
    "provenance",
    "frames",
    "name",
    "timing",
    "mode",
    "nodes",
    "factors",
    *_PROVENANCE,
}
_STEMS = ("trajectory_network", "trajectory_odometry", "trajectory_optimised")
_FILES = (
    *("config.yaml", "metrics.json", "graph.g2o", "loops.json", "places.npz"),
    *("report.html", "run.log"),
)
_MAP_FILES = ("map_mesh.ply", "map_cloud.ply")


def _violations(node: Any, wanted: Any, where: str) -> list[str]:
    """Violations of the schema of ``metrics.json`` in one of its parts."""
    if not isinstance(wanted, Mapping):
        right = isinstance(node, (int, float) if wanted is float else wanted) and (
            wanted is bool or node is not True
        )
        return [] if right else [f"{where} is {node!r}, not {wanted.__name__}"]
    if not isinstance(node, dict):
        return [f"{where} is {node!r}, not an object"]
    found = []
    for key, kind in wanted.items():
        place = f"{where}.{key}"
        if key not in node:
            found.append(f"{place} is missing")
        elif node[key] is not None:
            found += _violations(node[key], kind, place)
        elif key in _ALWAYS:
            found.append(f"{place} is null")
        elif not isinstance(node.get(f"{key}_reason"), str) or not node[f"{key}_reason"]:
            found.append(f"{place} is null without a reason")
    return found


@pytest.fixture(scope="session")
def check_run() -> Callable[[Path], dict[str, Any]]:
    """Checks that a folder holds every file of a run that ended well, and gives its metrics (design, 6 and 7)."""

    def check(path: Path) -> dict[str, Any]:
        def refuse(word):
            raise AssertionError(f"metrics.json holds {word}")

        metrics: dict[str, Any] = json.loads(
            (path / "metrics.json").read_text(), parse_constant=refuse
        )
        assert _violations(metrics, _METRICS, "metrics") == []
        assert (metrics["schema"], metrics["status"]) == (1, "ok")
        maps = _MAP_FILES if metrics["map"]["triangles"] else ()
        stems = (*_STEMS, "reference") if metrics["sequence"]["length_m"] is not None else _STEMS
        if metrics["trajectories"]["lidar"] is not None:
            maps = (*maps, "trajectory_lidar.kitti.txt", "trajectory_lidar.tum.txt")
        wanted = {
            *_FILES,
            *maps,
            *(f"{stem}.{kind}.txt" for stem in stems for kind in ("kitti", "tum")),
        }
        # a camera and a mask where something is fixed to the camera
        written = {file.name for file in path.iterdir()}
        assert wanted <= written <= wanted | {"camera.yaml", "mask.png"}
        for stem in stems:
            rows = np.loadtxt(path / f"{stem}.kitti.txt", ndmin=2)
            assert rows.shape == (metrics["sequence"]["frames"], 12) and np.isfinite(rows).all()
            np.testing.assert_allclose(rows[0], np.eye(4)[:3].ravel(), atol=1e-9)
            timed = np.loadtxt(path / f"{stem}.tum.txt", ndmin=2)
            np.testing.assert_allclose(timed[:, 1:4], rows[:, 3::4], atol=1e-8)
            assert (np.diff(timed[:, 0]) > 0).all()
        assert metrics["graph"]["nodes"] == metrics["sequence"]["frames"]
        return metrics

    return check


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """What damaged files make programs say may hold characters that xdist cannot send to its other processes."""
    report = yield
    report.sections = [
        (name, said.encode("utf-8", "backslashreplace").decode()) for name, said in report.sections
    ]
    return report


@pytest.fixture(scope="session")
def kitti_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A KITTI odometry root with the one sequence ``sim``: 14 frames of simulated world 1001. Not to be changed."""
    from slam.simulation.options import SimulationOptions
    from slam.simulation.recording import write_kitti_root
    from slam.simulation.street import SimulatedStreet

    root = tmp_path_factory.mktemp("kitti") / "root"
    options = SimulationOptions(route="straight", frames=14, seed=1001, width=208, height=64)
    write_kitti_root(SimulatedStreet(options), root)
    return root


@pytest.fixture
def copy_of_kitti_root(kitti_root: Path, tmp_path: Path) -> Callable[[], Path]:
    """Copies ``kitti_root`` to a place where a test may damage it."""
    return lambda: shutil.copytree(kitti_root, tmp_path / "damaged")


@pytest.fixture(scope="session")
def write_weights() -> Callable[..., Path]:
    """Writes small networks with random weights, as a training run would."""

    def write(
        folder: Path, trained_on: tuple[str, ...] = ("simulated/17",), sources: int = 4
    ) -> Path:
        import torch

        from erfsfm.checkpoint import Model, build_networks, save_model
        from erfsfm.config import NetworkConfig
        from erfsfm.model_record import ModelRecord

        torch.manual_seed(0)
        network = NetworkConfig(
            depth_width=0.1, pose_width=0.125, height=64, width=208, sources=sources
        )
        record = ModelRecord(
            network=network, trained_on=list(trained_on), licence="none, untrained"
        )
        save_model(folder, Model(record, build_networks(network)))
        return folder

    return write


@pytest.fixture(scope="session")
def tiny_weights(
    tmp_path_factory: pytest.TempPathFactory, write_weights: Callable[..., Path]
) -> Path:
    """Small untrained networks."""
    return write_weights(tmp_path_factory.mktemp("weights"))


@pytest.fixture
def leaky_weights(tmp_path: Path, write_weights: Callable[..., Path]) -> Path:
    """The same, recorded as trained on the world of ``kitti_root``."""
    return write_weights(tmp_path / "leaky", ("simulated/1000-1100",))
