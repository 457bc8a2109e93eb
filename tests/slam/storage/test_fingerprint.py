"""The fingerprint changes with the code behind cached results."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import scipy
import torch

import erfsfm
import slam
from slam.storage import fingerprint as module
from slam.storage.fingerprint import code_fingerprint, fingerprint

PACKAGES = [Path(package.__file__ or "").parent for package in (erfsfm, slam)]
ABOVE = {"slam/exports", "slam/results", "slam/localisation", "erfsfm/training"}
SUBPACKAGES = sorted(
    {path.parent.relative_to(folder.parent).as_posix() for folder in PACKAGES for path in folder.rglob("*.py")}
)


@pytest.fixture(scope="module")
def copies(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    root = tmp_path_factory.mktemp("code")
    ignored = shutil.ignore_patterns("__pycache__", "weights", "_configs")
    return [Path(shutil.copytree(folder, root / folder.name, ignore=ignored)) for folder in PACKAGES]


def changed(copies: list[Path], path: Path) -> bool:
    before, content = fingerprint(copies), path.read_bytes()
    path.write_bytes(content + b"#")
    try:
        return fingerprint(copies) != before
    finally:
        path.write_bytes(content)


@pytest.mark.parametrize("package", [package for package in SUBPACKAGES if package not in ABOVE])
def test_a_byte_in_any_package_behind_cached_results_changes_the_fingerprint(copies: list[Path], package: str) -> None:
    folder = copies[0].parent / package
    above = {"cli.py", "__main__.py", "doctor.py", "run.py"} if folder in copies else set()
    sources = [path for path in folder.glob("*.py") if path.name not in above]
    assert sources and all(changed(copies, path) for path in sources)


def test_reports_and_command_lines_leave_it_as_it_is(copies: list[Path]) -> None:
    root = copies[0].parent
    assert not any(changed(copies, root / name) for name in ("slam/cli.py", "slam/run.py", "slam/results/report.py"))


def test_a_new_and_a_renamed_source_are_noticed(copies: list[Path]) -> None:
    before, new = fingerprint(copies), copies[0] / "networks" / "another.py"
    new.write_text("")
    added = fingerprint(copies)
    new = new.rename(new.with_name("other.py"))
    renamed = fingerprint(copies)
    new.unlink()
    assert len({before, added, renamed}) == 3 and fingerprint(copies) == before


def test_the_libraries_below_are_named() -> None:
    known = code_fingerprint()
    for library in (torch, np, cv2, scipy):
        assert f"{library.__name__} {library.__version__.partition('+')[0]}" in known
    assert module.fingerprint(PACKAGES[::-1]) in known
