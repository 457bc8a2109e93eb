"""The readers are for both packages: none of them loads torch."""

from __future__ import annotations

import subprocess
import sys


def test_no_reader_imports_torch() -> None:
    code = (
        "import importlib, pkgutil, sys, erfsfm.common.readers as package\n"
        "names = [module.name for module in pkgutil.iter_modules(package.__path__)]\n"
        "for name in names: importlib.import_module(f'erfsfm.common.readers.{name}')\n"
        "print(len(names), [m for m in ('torch', 'gtsam', 'open3d', 'lightning') if m in sys.modules])"
    )
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    count, loaded = answer.stdout.split(maxsplit=1)
    assert int(count) >= 9 and loaded.strip() == "[]"
