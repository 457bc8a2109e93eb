"""The sdist, and the wheel made from it, which runs in an environment of its own, in an empty folder and offline."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import sysconfig
import tarfile
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import hatchling.build
import pytest
import twine.commands.check

pytestmark = pytest.mark.slow
ROOT = Path(__file__).resolve().parents[2]
SHIPPED = ("erfsfm", "slam")
NO_NETWORK = """
import socket

connect = socket.socket.connect

def connect_on_this_machine(self, address):
    if self.family != socket.AF_UNIX:
        raise OSError(f"the test allows no network; asked for {address}")
    connect(self, address)

socket.socket.connect = connect_on_this_machine
"""


def call(*command: object, folder: Path, **environment: str) -> str:
    """Standard output of a command that must succeed, in a folder outside the tree."""
    own = {
        name: value
        for name, value in os.environ.items()
        if name not in ("PYTHONPATH", "KITTI_ODOMETRY")
    }
    words = [str(word) for word in command]
    finished = subprocess.run(
        words,
        cwd=folder,
        env=own | environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    assert finished.returncode == 0, f"{' '.join(words)}\n{finished.stdout}\n{finished.stderr}"
    return finished.stdout


@dataclass(frozen=True)
class Installed:
    """The wheel of the sdist in an environment of its own."""

    sdist: Path
    wheel: Path
    environment: Path

    def run(self, folder: Path, program: str, *arguments: object) -> str:
        """Standard output of one of the environment's programs."""
        return call(self.environment / "bin" / program, *arguments, folder=folder)


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Installed:
    """A new environment with the wheel; dependencies are read from this one, its own install of the packages is not."""
    folder = tmp_path_factory.mktemp("wheel")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(ROOT)
        sdist = folder / hatchling.build.build_sdist(str(folder))
        with tarfile.open(sdist) as archive:
            archive.extractall(folder, filter="data")
        patch.chdir(folder / sdist.name.removesuffix(".tar.gz"))
        wheel = folder / hatchling.build.build_wheel(str(folder))
    environment = folder / "environment"
    call(sys.executable, "-m", "venv", "--without-pip", environment, folder=folder)
    python = environment / "bin" / "python"
    call(
        sys.executable,
        "-m",
        "pip",
        "--python",
        python,
        "install",
        "--quiet",
        "--no-compile",
        "--no-deps",
        "--no-index",
        wheel,
        folder=folder,
    )
    (packages,) = environment.glob("lib/python*/site-packages")
    # a path in a .pth file is added as it is: .pth files in it, as that of an editable install, are not read
    (packages / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    (packages / "sitecustomize.py").write_text(NO_NETWORK)
    return Installed(sdist, wheel, environment)


def test_the_wheel_holds_the_packages_whole(installed: Installed):
    names = set(zipfile.ZipFile(installed.wheel).namelist())
    for package in SHIPPED:
        files = {
            path
            for path in (ROOT / package).rglob("*")
            if path.is_file() and "__pycache__" not in path.parts
        }
        assert {str(path.relative_to(ROOT)) for path in files} <= names
    assert {name.split("/")[0] for name in names if ".dist-info/" not in name} == set(SHIPPED)
    for file in (ROOT / "configs").rglob("*.yaml"):
        package, *rest = file.relative_to(ROOT / "configs").parts
        parts = (
            ("erfsfm", "_configs", "splits", *rest)
            if package == "splits"
            else (package, "_configs", *rest)
        )
        assert "/".join(parts) in names


def test_an_index_takes_both(installed: Installed):
    assert not twine.commands.check.check([str(installed.sdist), str(installed.wheel)], strict=True)
    with tarfile.open(installed.sdist) as archive:
        names = {Path(*Path(name).parts[1:]).as_posix() for name in archive.getnames()}
    assert {
        "Makefile",
        "constraints.txt",
        "requirements.lock",
        "tests/conftest.py",
        "CONTRIBUTING.md",
    } <= names


def test_the_programs_are_those_of_the_wheel(installed: Installed, tmp_path: Path):
    where = installed.run(
        tmp_path, "python", "-c", "import erfsfm, slam; print(erfsfm.__file__, slam.__file__)"
    )
    assert all(Path(file).is_relative_to(installed.environment) for file in where.split())


def test_it_runs(installed: Installed, tmp_path: Path, check_run: Callable[[Path], dict[str, Any]]):
    installed.run(tmp_path, "erfsfm-slam", "run", "--frames", "0:40")
    metrics = check_run(tmp_path / "results" / "latest")
    assert metrics["sequence"]["frames"] == 40 and metrics["map"]["triangles"] > 1000


def test_it_trains_by_name(installed: Installed, tmp_path: Path):
    assert {
        row["name"] for row in json.loads(installed.run(tmp_path, "erfsfm", "networks", "--json"))
    } >= {"depthnet"}
    size = ("--route", "straight", "--frames", 12, "--width", 208, "--height", 64)
    installed.run(tmp_path, "erfsfm-slam", "simulate", "world", *size)
    options = (
        "--config",
        "tiny",
        "--set",
        "training.steps=2",
        "--dataset",
        "world",
        "--output",
        "toy",
    )
    installed.run(tmp_path, "erfsfm", "train", *options)
    assert (tmp_path / "toy" / "model.yaml").is_file()
