"""Every tool has a help text with an example, and docs/settings.md is the page that its tool writes."""

import runpy
import sys
from pathlib import Path

import pytest

TOOLS = Path(__file__).parents[2] / "tools"


@pytest.mark.parametrize("tool", sorted(TOOLS.glob("*.py")), ids=lambda p: p.name)
def test_help_shows_an_example(
    tool: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.syspath_prepend(str(TOOLS))
    monkeypatch.setattr(sys, "argv", [str(tool), "--help"])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(tool), run_name="__main__")
    assert not ended.value.code
    assert "Example:" in capsys.readouterr().out


def test_the_page_of_settings_is_current(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
