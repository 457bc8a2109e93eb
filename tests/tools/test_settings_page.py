"""docs/settings.md is the page that the tool writes."""

import importlib
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]

sys.path.insert(0, str(ROOT / "tools"))
settings_page = importlib.import_module("settings_page")


def test_the_page_is_current(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["settings_page.py", "--output", str(tmp_path / "settings.md")])
    settings_page.main()
    written = (tmp_path / "settings.md").read_text(encoding="utf-8")
    assert written == (ROOT / "docs/settings.md").read_text(encoding="utf-8"), "run python tools/settings_page.py"
    for key in ("scale.known_between", "training.networks", "initial_weights"):
        assert f"| `{key}` |" in written
