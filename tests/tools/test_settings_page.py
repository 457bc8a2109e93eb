"""docs/settings.md is the page that its tool writes."""

import runpy
import sys
from pathlib import Path

import pytest

TOOLS = Path(__file__).parents[2] / "tools"


def test_the_page_of_settings_is_current(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.syspath_prepend(str(TOOLS))
    monkeypatch.setattr(
        sys, "argv", ["settings_page.py", "--output", str(tmp_path / "settings.md")]
    )
    runpy.run_path(str(TOOLS / "settings_page.py"), run_name="__main__")
    written = (tmp_path / "settings.md").read_text(encoding="utf-8")
    assert written == (TOOLS.parent / "docs/settings.md").read_text(encoding="utf-8"), (
        "run python tools/settings_page.py"
    )
    for key in ("scale.known_between", "training.networks", "initial_weights"):
        assert f"| `{key}` |" in written
