"""YAML: values that are read, and the limits on size, depth, duplicates and aliases."""

from __future__ import annotations

from pathlib import Path

import pytest

from erfsfm.common.yaml_file import MAX_BYTES, YamlError, parse_yaml, read_yaml


def chain(first: str, level: str) -> str:
    """Anchors a to i, each of which repeats the one before nine times."""
    lines = [f"a: &a {first}"]
    for before, name in zip("abcdefgh", "bcdefghi"):
        lines.append(f"{name}: &{name} " + level.format(",".join([f"*{before}"] * 9)))
    return "\n".join(lines)


def refusal(text: str) -> str:
    with pytest.raises(YamlError) as caught:
        parse_yaml(text)
    message = str(caught.value)
    assert "\n" not in message
    assert len(message) < 300
    return message


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[" * 3000, "nested levels"),
        ("{a: " * 3000, "nested levels"),
        ("- " * 3000 + "x", "nested levels"),
        ("? " * 3000, "nested levels"),
        (chain("[x,x,x,x,x,x,x,x,x]", "[{}]"), "more than 100000 values (line 6)"),
        (chain("{k: 1}", "{{<<: [{}]}}"), "more than 100000 values (line 6)"),
        ("[" + "a," * 110_000 + "]", "more than 100000 values"),
        ("a: &a [*a]", "contains itself"),
        ("a: &a {b: *a}", "contains itself"),
        ("a: 1\nb: 2\n'a': 3", "duplicate key 'a' (line 3)"),
        ("x: {y: 1, y: 1}", "duplicate key 'y'"),
        ("? [a]\n: 1", "unhashable"),
        ("x: 2011-99-99", "month"),
        ("x: " + "9" * 5000, "digits"),
        ("x: !!bool x", "its tag"),
        ("!!timestamp x", "its tag"),
        ("!!python/object/apply:os.getcwd []", "constructor"),
        ("a: b: c", "line 1"),
        ("--- a\n--- b", "another document"),
        ("\x00", "special characters"),
    ],
)
def test_refused_yaml_is_one_line(text: str, words: str) -> None:
    """Of aliases that repeat aliases the line shows that they were refused before they were followed."""
    assert words in refusal(text)


def test_numbers_lists_aliases_and_merges_are_read() -> None:
    assert parse_yaml("1e-4") == 1e-4
    assert parse_yaml("[1E5, -2e+3, .5e1, 1.0]") == [1e5, -2e3, 5.0, 1.0]
    assert parse_yaml("a: &x {k: 1, l: 2}\nb: *x\nc: {<<: *x, k: 3}") == {
        "a": {"k": 1, "l": 2},
        "b": {"k": 1, "l": 2},
        "c": {"k": 3, "l": 2},
    }
    assert parse_yaml("[" * 30 + "]" * 30)
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
    with pytest.raises(YamlError, match="larger than 256 KiB"):
        read_yaml(path)
    for wrong in (tmp_path, tmp_path / "none.yaml", Path("/dev/zero")):
        with pytest.raises(YamlError, match="not there, or not a file"):
            read_yaml(wrong)
