"""Every tool has a help text with an example, and shipping weights writes a model card."""

import subprocess
import sys
from pathlib import Path

import pytest

TOOLS = Path(__file__).parents[2] / "tools"


@pytest.mark.parametrize("tool", sorted(TOOLS.glob("*.py")), ids=lambda p: p.name)
def test_help_shows_an_example(tool: Path) -> None:
    finished = subprocess.run([sys.executable, str(tool), "--help"], capture_output=True, text=True, check=False)
    assert finished.returncode == 0, finished.stderr
    assert "Example:" in finished.stdout
