"""Open3D without its windows, which are there where they are used, and whole in a notebook."""

from __future__ import annotations

import subprocess
import sys

import pytest

WINDOWS = """
import sys
from slam.runtime.imports import import_open3d

o3d = import_open3d()
assert not {"dash", "plotly", "IPython"} & set(sys.modules)
assert not hasattr(o3d, "nonesuch")
from open3d.visualization import rendering
assert o3d.visualization.draw_geometries and o3d.visualization is sys.modules["open3d.visualization"]
"""

IN_NOTEBOOK = """
import builtins, sys
from slam.runtime.imports import import_open3d

class ZMQInteractiveShell:  # which Open3D asks for
    pass

builtins.get_ipython, sys.modules["ipykernel"] = ZMQInteractiveShell, sys
assert import_open3d().visualization.draw_plotly
"""


@pytest.mark.parametrize(
    "code",
    [WINDOWS, pytest.param(IN_NOTEBOOK, marks=pytest.mark.slow)],
    ids=["windows at their first use", "whole in a notebook"],
)
def test_open3d_is_imported(code: str):
    finished = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False
    )
    assert finished.returncode == 0, finished.stderr
