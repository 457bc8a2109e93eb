"""A run opens no connection: with sockets forbidden it does all of its work."""

from __future__ import annotations

import socket
from pathlib import Path
from typing import Any, NoReturn

import pytest

from slam import run_slam


def test_the_demo_runs_without_sockets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def forbidden(*_: Any, **__: Any) -> NoReturn:
        raise AssertionError("a socket was opened")

    monkeypatch.setattr(socket, "socket", forbidden)
    monkeypatch.setattr(socket, "create_connection", forbidden)
    monkeypatch.setattr(socket, "getaddrinfo", forbidden)
    run = run_slam(frames="0:7", weights="sim", output=tmp_path / "run", overrides=["mapping.voxel_size_m=0.5"])
    assert run.metrics()["status"] == "ok" and (run.path / "report.html").is_file()
