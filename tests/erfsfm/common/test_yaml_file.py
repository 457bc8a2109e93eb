"""YAML: values that are read, and what is refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from erfsfm.common.yaml_file import MAX_BYTES, YamlError, parse_yaml, read_yaml


@pytest.mark.parametrize(
    "text",
    [
        "[" * 30_000,
        "a: 1\nb: 2\n'a': 3",
        "? [a]\n: 1",
        "x: 2011-99-99",
        "!!python/object/apply:os.getcwd []",
        "a: b: c",
    ],
)
def test_refused_yaml_is_one_line(text: str) -> None:
    with pytest.raises(YamlError) as caught:
        parse_yaml(text)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 300


def test_numbers_and_lists_are_read() -> None:
    assert parse_yaml("1e-4") == 1e-4
    assert parse_yaml("[1E5, -2e+3, .5e1, 1.0]") == [1e5, -2e3, 5.0, 1.0]
    assert parse_yaml("") is None


def test_files(tmp_path: Path) -> None:
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
