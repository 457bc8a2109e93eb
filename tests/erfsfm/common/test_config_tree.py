"""Configurations of both packages: overrides, old names, the origin of an error."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Literal

import pytest

from erfsfm.common.config_tree import Section, dump_explained, dump_yaml, load_config
from erfsfm.common.errors import ConfigError
from erfsfm.common.yaml_file import parse_yaml


class Flow(Section):
    """Optical flow, see `tracking`."""

    method: Literal["sparse", "dense"] = "sparse"
    window_px: int = 11


class Gaps(Section):
    """Gaps."""

    enabled: bool = True


class Settings(Section):
    """Two sections."""

    flow: Flow = Flow()
    gaps: Gaps = Gaps()


def load(file: Path | None = None, *overrides: str) -> Settings:
    return load_config(Settings, file, overrides, [])


def refusal(file: Path | None, *overrides: str) -> str:
    with pytest.raises(ConfigError) as caught:
        load(file, *overrides)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_files_and_overrides(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_text("flow: {method: dense, window_px: 7}")
    assert load(path, "flow.window_px=9", "flow.window_px=13", "gaps={enabled: false}") == Settings(
        flow=Flow(method="dense", window_px=13), gaps=Gaps(enabled=False)
    )


@pytest.mark.parametrize(
    "text", ["flow.side=3", "flow={side: 3}", "bridging.enabled=false", "bridging={}", "bridging="]
)
def test_an_unknown_key_is_one_line(tmp_path: Path, text: str) -> None:
    key = "flow.side" if text.startswith("flow") else "bridging"
    assert re.search(
        rf"unknown key '{key}.*' in --set {re.escape(text)}; (known keys|did you mean)", refusal(None, text)
    )
    path = tmp_path / "a.yaml"
    path.write_text("flow: {side: 3}")
    assert f"unknown key 'flow.side' in {path}" in refusal(path)


def test_an_error_names_its_origin(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_text("flow: {window_px: x}")
    assert "a.yaml should be a valid integer" in refusal(path)
    path.write_text("{}")
    assert "'flow.window_px' in --set flow.window_px=x should be" in refusal(path, "flow.window_px=x")
    assert "in --set flow.window_px.x=3 should be" in refusal(path, "flow.window_px.x=3")
    assert "in --set flow={window_px: x} should be" in refusal(path, "flow={window_px: x}")
    assert len(refusal(path, f"flow.window_px=[{'1,' * 5000}]")) < 10_500  # of which the override itself is most


def test_both_dumps_read_back() -> None:
    settings = load(None, "flow.window_px=5")
    for text in (dump_yaml(settings), dump_explained(settings)):
        assert Settings.model_validate(parse_yaml(text)) == settings
    assert dump_explained(settings).startswith("flow:  # Optical flow")
