"""Quiet, repeatable surroundings for every test, and the way to the real recordings."""

from __future__ import annotations

import os
import random
import sys
import tempfile
from pathlib import Path

# Read when NumPy and torch are first imported, so before any test module: one thread, and none that spins.
os.environ["OMP_WAIT_POLICY"] = "PASSIVE"
for _threads in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[_threads] = "1"
os.environ["MPLBACKEND"] = "Agg"
# The font cache is costly to build: it outlives the session, unlike the home folder below.
os.environ.setdefault("MPLCONFIGDIR", str(Path(tempfile.gettempdir()) / f"erfsfm-slam-matplotlib-{os.getuid()}"))

import numpy as np  # noqa: E402
import pytest  # noqa: E402


@pytest.fixture(scope="session", autouse=True)
def _home_of_its_own(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Keep evo and others from leaving settings in the user's home."""
    os.environ["HOME"] = str(tmp_path_factory.mktemp("home"))


@pytest.fixture(autouse=True)
def _seeded() -> None:
    """The same chance in every test; torch only where a test has loaded it."""
    random.seed(0)
    np.random.seed(0)
    if "torch" in sys.modules:
        sys.modules["torch"].manual_seed(0)


@pytest.fixture(scope="session")
def data_root() -> Path:
    """The folder of real recordings: $ERFSFM_DATA, or ``shared/data`` beside the repository."""
    root = Path(os.environ.get("ERFSFM_DATA") or Path(__file__).parents[2] / "shared" / "data")
    if not root.is_dir():
        pytest.skip(f"no real recordings in {root}; set ERFSFM_DATA to their folder")
    return root
