"""Configurations of both packages: overrides, old names, the origin of an error."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Literal

import pytest
from pydantic import BaseModel

from erfsfm.common.config_tree import (
    MAX_BYTES,
    Section,
    YamlError,
    dump_explained,
    dump_yaml,
    load_config,
    parse_yaml,
    read_yaml,
)
from erfsfm.common.errors import ConfigError


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


def test_files_and_overrides(tmp_path: Path):
    path = tmp_path / "a.yaml"
    path.write_text("flow: {method: dense, window_px: 7}")
    assert load(path, "flow.window_px=9", "flow.window_px=13", "gaps={enabled: false}") == Settings(
        flow=Flow(method="dense", window_px=13), gaps=Gaps(enabled=False)
    )


@pytest.mark.parametrize(
    "text", ["flow.side=3", "flow={side: 3}", "bridging.enabled=false", "bridging={}", "bridging="]
)
def test_an_unknown_key_is_one_line(tmp_path: Path, text: str):
    key = "flow.side" if text.startswith("flow") else "bridging"
    assert re.search(
        rf"unknown key '{key}.*' in --set {re.escape(text)}; (known keys|did you mean)",
        refusal(None, text),
    )
    path = tmp_path / "a.yaml"
    path.write_text("flow: {side: 3}")
    assert f"unknown key 'flow.side' in {path}" in refusal(path)


def test_an_error_names_its_origin(tmp_path: Path):
    path = tmp_path / "a.yaml"
    path.write_text("flow: {window_px: x}")
    assert "a.yaml should be a valid integer" in refusal(path)
    path.write_text("{}")
    assert "'flow.window_px' in --set flow.window_px=x should be" in refusal(
        path, "flow.window_px=x"
    )
    assert "in --set flow.window_px.x=3 should be" in refusal(path, "flow.window_px.x=3")
    assert "in --set flow={window_px: x} should be" in refusal(path, "flow={window_px: x}")
    assert (
        len(refusal(path, f"flow.window_px=[{'1,' * 5000}]")) < 10_500
    )  # of which the override itself is most


def test_both_dumps_read_back():
    settings = load(None, "flow.window_px=5")
    for text in (dump_yaml(settings), dump_explained(settings)):
        assert Settings.model_validate(parse_yaml(text)) == settings
    assert dump_explained(settings).startswith("flow:  # Optical flow")


@pytest.mark.parametrize(
    "text",
    [
        pytest.param("[" * 3_000, marks=pytest.mark.slow, id="deep"),
        "a: 1\nb: 2\n'a': 3",
        "? [a]\n: 1",
        "x: 2011-99-99",
        "!!python/object/apply:os.getcwd []",
        "a: b: c",
    ],
)
def test_refused_yaml_is_one_line(text: str):
    with pytest.raises(YamlError) as caught:
        parse_yaml(text)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 300


def test_numbers_and_lists_are_read():
    assert parse_yaml("1e-4") == 1e-4
    assert parse_yaml("[1E5, -2e+3, .5e1, 1.0]") == [1e5, -2e3, 5.0, 1.0]
    assert parse_yaml("") is None


def test_text_that_looks_like_a_number_is_read_back_as_text():
    """One commit in a hundred is written as 8e4572260207."""

    class Record(BaseModel):
        commit: str

    for commit in ("8e4572260207", "1e5", "123456789012", "1.5", "null", "-.5E+3"):
        assert parse_yaml(dump_yaml(Record(commit=commit))) == {"commit": commit}


def test_files(tmp_path: Path):
    path = tmp_path / "a.yaml"
    path.write_text("\ufeffname: Zürich\n", encoding="utf-8")
    assert read_yaml(path) == {"name": "Zürich"}
    path.write_text("a: [")
    with pytest.raises(YamlError, match=r"a\.yaml is not YAML: .*line 1"):
        read_yaml(path)
    path.write_bytes(bytes(range(128, 256)))
    with pytest.raises(YamlError, match=r"a\.yaml is not YAML: it is not UTF-8"):
        read_yaml(path)
    path.write_text("# comment\n" * (MAX_BYTES // 10 + 1))
    with pytest.raises(YamlError, match=r"larger than 0\.25 MiB"):
        read_yaml(path)
    for wrong in (tmp_path, tmp_path / "none.yaml", Path("/dev/zero")):
        with pytest.raises(YamlError, match="not there, or not a file"):
            read_yaml(wrong)
