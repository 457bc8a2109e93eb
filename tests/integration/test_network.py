"""A run opens no connection: with sockets forbidden it does all of its work."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any, NoReturn

import pytest

from slam import run_slam


def test_the_demo_runs_without_sockets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def forbidden(*_: Any, **__: Any) -> NoReturn:
        raise AssertionError("a socket was opened")

    monkeypatch.setattr(socket, "socket", forbidden)
    monkeypatch.setattr(socket, "create_connection", forbidden)
    monkeypatch.setattr(socket, "getaddrinfo", forbidden)
    run = run_slam(
        frames="0:7", weights="sim", output=tmp_path / "run", overrides=["mapping.voxel_size_m=0.5"]
    )
    assert run.metrics().tree()["status"] == "ok" and (run.path / "report.html").is_file()


def test_onnx_runtime_keeps_nothing_to_report(tmp_path: Path):
    """Unless told not to, it reports to its maker, by an identifier that it keeps in the home folder."""
    environment = {
        name: value for name, value in os.environ.items() if name != "ORT_DISABLE_TELEMETRY"
    }
    place = {"HOME": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path / "cache")}
    subprocess.run(
        [sys.executable, "-c", "import slam.prediction.depth_source"],
        env=environment | place,
        check=True,
    )
    assert not list(tmp_path.rglob("*onnxruntime*"))
