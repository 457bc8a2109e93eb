"""The fingerprint changes with the code behind cached results, and with no other."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import scipy
import torch

import slam
from slam.runtime.storage.fingerprint import code_fingerprint, fingerprint, sources

ROOT = Path(slam.__file__ or "").parents[1]


@pytest.fixture(scope="module")
def copy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("code")
    for package in ("erfsfm", "slam"):
        ignored = shutil.ignore_patterns("__pycache__", "weights", "_configs")
        shutil.copytree(ROOT / package, root / package, ignore=ignored)
    return root


def is_noticed(root: Path, name: str) -> bool:
    path, before = root / name, fingerprint(root)
    content = path.read_bytes()
    path.write_bytes(content + b"#")
    try:
        return fingerprint(root) != before
    finally:
        path.write_bytes(content)


def test_every_module_that_a_prediction_loads_is_among_the_sources() -> None:
    """The doors of both packages are not: they load everything and compute nothing."""
    loads = "import sys, slam.prediction.assembly; print(*(m.__file__ for m in sys.modules.values() if "
    loads += "m.__name__.startswith(('slam.prediction', 'slam.runtime.storage', 'erfsfm.networks'))))"
    loaded = subprocess.run([sys.executable, "-c", loads], cwd=ROOT, capture_output=True, text=True, check=True)
    assert len(loaded.stdout.split()) > 10
    assert set(map(Path, loaded.stdout.split())) <= set(sources(ROOT))


@pytest.mark.parametrize("name", ["slam/prediction/networks.py", "slam/geometry/se3.py", "erfsfm/networks/presets.py"])
def test_a_byte_behind_cached_results_is_noticed(copy: Path, name: str) -> None:
    assert is_noticed(copy, name)


@pytest.mark.parametrize(
    "folder",
    ["batch", "calibration", "downloads", "exports", "live", "localisation", "results"],
)
def test_reports_and_command_lines_leave_it_as_it_is(folder: str) -> None:
    assert not [path for path in sources(ROOT) if path.is_relative_to(ROOT / "slam" / folder)]
    assert ROOT / "slam" / "cli.py" not in sources(ROOT)


def test_a_new_source_is_noticed_where_something_imports_it(copy: Path) -> None:
    before, new = fingerprint(copy), copy / "slam" / "prediction" / "another.py"
    new.write_text("")
    assert fingerprint(copy) == before
    user = copy / "slam" / "prediction" / "networks.py"
    content = user.read_bytes()
    user.write_bytes(content + b"\nfrom slam.prediction import another\n")
    imported = fingerprint(copy)
    new.write_text("# changed")
    assert len({before, imported, fingerprint(copy)}) == 3
    user.write_bytes(content)
    new.unlink()


def test_the_libraries_below_are_named() -> None:
    known = code_fingerprint()
    for library in (torch, np, cv2, scipy):
        assert f"{library.__name__} {library.__version__.partition('+')[0]}" in known
    assert fingerprint(ROOT) in known
