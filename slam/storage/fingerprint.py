"""Which code computed a cached answer: the sources of both packages and the versions of the libraries below them."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

import cv2
import numpy as np
import scipy

import erfsfm

# They use what was computed, and compute nothing that is cached: the layers in pyproject.toml keep all other code from
# importing them.
_ABOVE_THE_CACHE = (
    *("slam/cli.py", "slam/__main__.py", "slam/doctor.py", "slam/run.py", "slam/localisation/", "slam/results/"),
    *("erfsfm/cli.py", "erfsfm/training/"),
)


@functools.cache
def code_fingerprint() -> str:
    """Of all code that decides a cached answer, and of torch, NumPy, OpenCV and SciPy: another one, other answers."""
    own = Path(__file__).parents[1], Path(erfsfm.__file__).parent
    libraries = (f"{library.__name__} {library.__version__}" for library in (np, cv2, scipy))
    return " ".join((fingerprint(own), *libraries, f"torch {version('torch')}"))


def fingerprint(packages: Sequence[Path]) -> str:
    """Of the sources of some packages, each given by its folder."""
    digest = hashlib.sha256()
    for package in packages:
        for path in sorted(package.rglob("*.py")):
            name = path.relative_to(package.parent).as_posix()
            if not name.startswith(_ABOVE_THE_CACHE):
                digest.update(name.encode() + b"\0" + hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()
