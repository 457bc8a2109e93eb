"""What both command lines share: words of no use, errors of every kind as one line."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
from collections.abc import Callable

import pytest

from erfsfm.common import command_line
from erfsfm.common.errors import DataError

Outcome = Callable[..., tuple[int, str]]


@pytest.fixture
def outcome(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Outcome:
    """Exit code and stderr of a program that does something with its words."""

    def run(does: Callable[[list[str]], object], *words: str) -> tuple[int, str]:
        monkeypatch.setattr(sys, "argv", ["program", *words])
        with pytest.raises(SystemExit) as stopped:
            command_line.run(
                lambda args, prog_name: sys.exit(does(args)), "program", logging.WARNING
            )
        return int(stopped.value.code or 0), capsys.readouterr().err

    return run


def test_a_warning_that_repeats_is_said_once():
    program = "import logging\nfrom erfsfm.common import command_line\n"
    program += "def app(args, prog_name):\n for k in range(111): logging.getLogger('images').warning('image %d', k)\n"
    program += " raise OSError('the error')\ncommand_line.run(app, 'program', logging.WARNING)"
    said = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    ).stderr
    assert said.splitlines() == ["WARNING images: image 0", "program: the error"]


def test_a_terminal_in_ascii_shows_what_it_can():
    program = (
        "from erfsfm.common.command_line import run\n"
        "run(lambda args, prog_name: print('drive \u2014 m\u00fcde'), 'program', 30)"
    )
    ascii_only = {**os.environ, "PYTHONIOENCODING": "ascii:strict"}
    done = subprocess.run(
        [sys.executable, "-c", program], env=ascii_only, capture_output=True, text=True, check=True
    )
    assert done.stdout == "drive ? m?de\n"


def raising(error: Exception) -> Callable[[object], object]:
    def does(_: object) -> object:
        raise error

    return does


@pytest.mark.parametrize(
    "error, line",
    [
        (DataError("two\nlines"), "program: two lines"),
        (FileNotFoundError(2, "No such file", "a"), "program: a: No such file: check the path"),
        (MemoryError(), "program: memory ran out"),
        (
            RuntimeError("DefaultCPUAllocator: can't allocate memory: not enough memory"),
            "program: memory ran out",
        ),
        (
            ZeroDivisionError("by zero"),
            "program: unexpected ZeroDivisionError: by zero (test_command_line.py:",
        ),
    ],
)
def test_every_error_is_one_line(outcome: Outcome, error: Exception, line: str):
    code, err = outcome(raising(error))
    assert code == 1 and err.startswith(line) and len(err.splitlines()) == 1


@pytest.mark.parametrize(
    ("option", "said"), [("-q", ""), ("-v", "fine odd"), ("--quiet", ""), (None, "odd")]
)
def test_how_much_is_said_on_the_terminal(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    option: str | None,
    said: str,
):
    app = command_line.application("program", "It speaks.")

    @app.command()
    def speak() -> None:
        logging.getLogger("program").info("fine")
        logging.getLogger("program").warning("odd")

    root = logging.getLogger()
    monkeypatch.setattr(root, "handlers", [])
    monkeypatch.setattr(root, "level", root.level)
    monkeypatch.setattr(sys, "argv", ["program", *([option] if option else []), "speak"])
    with pytest.raises(SystemExit):
        command_line.run(app, "program", logging.WARNING)
    lines = capsys.readouterr().err.splitlines()
    assert " ".join(line.rpartition(": ")[2] for line in lines) == said
