"""Configurations of both packages: overrides, old names, the origin of an error."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import pytest

from erfsfm.common.config_tree import OldNames, Section, dump_explained, dump_yaml, load_config
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


OLD = OldNames({"flow.side": "flow.window_px", "bridging": "gaps"}, {("flow.method", "corners"): "sparse"})


def load(file: Path | None = None, *overrides: str) -> Settings:
    return load_config(Settings, file, overrides, [], OLD)


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


def test_an_override_of_a_section_changes_no_alias_of_it(tmp_path: Path) -> None:
    class Pair(Section):
        one: Flow
        two: Flow

    path = tmp_path / "a.yaml"
    path.write_text("one: &flow {window_px: 7}\ntwo: *flow")
    pair = load_config(Pair, path, ["one.window_px=9"], [])
    assert (pair.one.window_px, pair.two.window_px) == (9, 7)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("flow.side=3", "'flow.side' is now 'flow.window_px'"),
        ("flow={side: 3}", "'flow.side' is now 'flow.window_px'"),
        ("bridging.enabled=false", "'bridging.enabled' is now 'gaps.enabled'"),
        ("bridging={}", "'bridging' is now 'gaps'"),
        ("bridging=", "'bridging' is now 'gaps'"),
        ("flow.method=corners", "'flow.method: corners' is now 'flow.method: sparse'"),
    ],
)
def test_an_old_name_is_refused_with_the_new_one(tmp_path: Path, text: str, words: str) -> None:
    message = refusal(None, text)
    assert words in message
    assert f"--set {text}" in message


def test_every_old_name_of_a_file_is_named_at_once(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_text("flow: {side: 3}\nbridging: {enabled: false}")
    assert refusal(path).endswith(
        "a.yaml: 'flow.side' is now 'flow.window_px'; 'bridging.enabled' is now 'gaps.enabled'"
    )


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
