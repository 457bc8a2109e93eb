"""Damage to files by Hypothesis, and the property that every reader has: a sound value, or one line about the file."""

from __future__ import annotations

import io
import re
import sys
import warnings
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from erfsfm.common.errors import ErfsfmError
from slam.runtime.errors import SlamError

FEW = settings(max_examples=12, derandomize=True, deadline=None, database=None, suppress_health_check=[*HealthCheck])

_NUMBER = re.compile(rb"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")
_HOSTILE = (
    *(b"nan", b"inf", b"-inf", b"1e999", b"-1", b"0", b"1000000000000", b"9" * 60, b"1e308", b"1e-308", b"''"),
    *(b"null", b"true", b"[]", b"{}", b"[[1]]", b'"x"', b"\\ud800", b"x", b"0x10", b"1_0", b"", b"~"),
    b"!!python/name:os",
)
_LINE_ENDS = (b"\r\n", b"\r", b"\n\n", b"\x00", b" \n", b"\xc2\x85")


@st.composite
def damaged(draw: st.DrawFn, content: bytes) -> bytes:
    """A change of a file: bytes, length, numbers, line ends, encoding; inside an archive, of a member."""
    if zipfile.is_zipfile(io.BytesIO(content)) and draw(st.integers(0, 2)):
        return _with_member_changed(draw, content)
    size = len(content)
    place = draw(st.integers(0, min(size, draw(st.sampled_from([64, 1024, size])))))
    match draw(st.sampled_from(_CHANGES)):
        case "cut":
            return content[:place]
        case "flip":
            return (
                content[:place] + bytes([content[place] ^ 1 << draw(st.integers(0, 7))]) + content[place + 1 :]
                if (place < size)
                else content
            )
        case "overwrite":
            new = draw(st.binary(min_size=1, max_size=16))
            return content[:place] + new + content[place + len(new) :]
        case "insert":
            return content[:place] + draw(st.binary(min_size=1, max_size=16)) + content[place:]
        case "remove":
            return content[:place] + content[place + draw(st.integers(1, 64)) :]
        case "repeat":
            return content[:place] + content[: draw(st.integers(0, size))]
        case "number":
            found = [*_NUMBER.finditer(content[:20_000])]
            if not found:
                return b""
            number = draw(st.sampled_from(found))
            return content[: number.start()] + draw(st.sampled_from(_HOSTILE)) + content[number.end() :]
        case "line ends":
            return content.replace(b"\n", draw(st.sampled_from(_LINE_ENDS)))
        case "encoding":
            text = content.decode("latin-1")
            return text.encode(draw(st.sampled_from(["utf-16", "utf-32", "utf-8-sig", "utf-7"])))
        case "duplicate lines":
            lines = content.splitlines(keepends=True)
            return b"".join([*lines, lines[place % len(lines)]]) if lines else b""
    raise AssertionError("an unknown change")


_CHANGES = (
    *("cut", "flip", "overwrite", "insert", "remove", "repeat", "number", "number", "line ends", "encoding"),
    "duplicate lines",
)


def _with_member_changed(draw: st.DrawFn, content: bytes) -> bytes:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    chosen = draw(st.sampled_from(sorted(members)))
    if draw(st.integers(0, 5)):
        members[chosen] = draw(damaged(members[chosen]))
    else:
        del members[chosen]
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name, member in members.items():
            archive.writestr(name, member)
    return file.getvalue()


Read = Callable[[Path], Any]
Sound = Callable[[Any], bool]


def examine(path: Path, content: bytes, read: Read, sound: Sound, place: Path) -> None:
    """Read a changed file below a place; anything but a sound value or one line about it fails the test."""
    path.write_bytes(content)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            value = read(path)
        except (SlamError, ErfsfmError) as error:
            _check_line(str(error), path, place)
            return
    assert value is None or sound(value)


def _check_line(line: str, path: Path, place: Path) -> None:
    assert "\n" not in line and len(line) < 1000, line
    assert path.name in line or path.parent.name in line or str(place) in line, line


@pytest.fixture
def damage_file(tmp_path: Path) -> Callable[[Path, Read, Sound], None]:
    """Damages a file some times, and examines what reads it."""

    def damage(path: Path, read: Read, sound: Sound) -> None:
        sample = path.read_bytes()

        @FEW
        @given(damaged(sample))
        def hold(content: bytes) -> None:
            examine(path, content, read, sound, tmp_path)

        hold()

    return damage


@pytest.fixture
def refuse_folder(tmp_path: Path) -> Callable[[Path, Read], None]:
    """Puts a folder in the place of a file, which must be refused in one line about it."""

    def refuse(path: Path, read: Read) -> None:
        path.unlink()
        path.mkdir()
        with pytest.raises((SlamError, ErfsfmError)) as raised:
            read(path)
        _check_line(str(raised.value), path, tmp_path)

    return refuse


@pytest.fixture(scope="session")
def call() -> Callable[[Callable[[], None], Sequence[object]], int]:
    """Exit code of a command line."""

    def called(main: Callable[[], None], words: Sequence[object]) -> int:
        with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit) as stopped:
            patch.setattr(sys, "argv", ["program", *map(str, words)])
            main()
        return int(stopped.value.code or 0)

    return called
