"""Code of both command lines: it checks their words, and turns every error into one line and an exit code."""

from __future__ import annotations

import faulthandler
import logging
import os
import re
import sys
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NoReturn, TextIO

import typer

from erfsfm import __version__
from erfsfm.common.errors import explained, shows_traceback
from erfsfm.common.signals import Terminated

# what they would say of a file is said in our own line
_OPENCV = {"OPENCV_LOG_LEVEL": "SILENT", "OPENCV_FFMPEG_LOGLEVEL": "-8"}
_INTERRUPTED = 130  # exit code that typer gives to ctrl-C
_OPTION = re.compile(r"--[a-z][a-z-]*=")
_MAY_BE_EMPTY = ("--hazards", "--hazards=")


class Terminal(logging.StreamHandler[TextIO]):
    """Standard error, to which a warning of one kind is said once, and at the end how often besides.

    One logged with the ``extra`` `COUNTED` is said at the end, with its number.
    """

    def __init__(self, level: int) -> None:
        super().__init__(sys.stderr)
        self.setLevel(level)
        self._times: Counter[str] = Counter()
        self._held: dict[str, logging.LogRecord] = {}
        logging.basicConfig(level=level, format="%(levelname)s %(name)s: %(message)s", handlers=[self])

    def emit(self, record: logging.LogRecord) -> None:
        """Say a record, unless one like it was said."""
        kind = f"{record.name}: {record.msg}"
        if record.levelno == logging.WARNING:
            self._times[kind] += 1
        if hasattr(record, "counted"):
            self._held.setdefault(kind, record)
        elif self._times[kind] <= 1:
            super().emit(record)

    def count(self) -> None:
        """Say what was not said."""
        for kind, times in self._times.items():
            if kind in self._held:
                _say(self.format(self._held.pop(kind)) + f" ({times} such warnings)" * (times > 1))
            elif times > 1:
                _say(f"WARNING {kind.partition(':')[0]}: {times - 1} more warnings of this kind")
        self._times.clear()


def application(name: str, about: str) -> typer.Typer:
    """A program of several verbs: plain help, since markup would lose what stands in brackets, and ``--version``."""
    app = typer.Typer(no_args_is_help=True, rich_markup_mode=None, pretty_exceptions_enable=False, help=about)

    def print_version(wanted: bool) -> None:
        if wanted:
            typer.echo(f"{name} {__version__}")
            raise typer.Exit

    @app.callback()
    def of_all_verbs(
        version: bool = typer.Option(
            False, "--version", callback=print_version, is_eager=True, help="print the version and exit"
        ),
    ) -> None:
        pass

    return app


def run(app: Callable[..., object], name: str, level: int) -> None:
    """Run a command line on ``sys.argv`` that logs from a ``level`` on.

    A known error becomes one line on stderr and exit code 1.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    for variable, value in _OPENCV.items():
        os.environ.setdefault(variable, value)
    _quieten_libraries()
    Terminal(level)
    try:
        try:
            app(args=_checked(sys.argv[1:], name), prog_name=name)
        finally:  # the last line is that of the error
            for handler in logging.getLogger().handlers:
                if isinstance(handler, Terminal):
                    handler.count()
    except SystemExit as end:
        if end.code == _INTERRUPTED or isinstance(end, Terminated):
            why = str(end) if isinstance(end, Terminated) else "interrupted"
            _say(f"{name}: {why}; what was written stays")
        raise
    except Exception as error:  # the last place where an error can become one line
        if shows_traceback():
            raise
        _end(f"{name}: {explained(error)}", 1)


def _quieten_libraries() -> None:
    """Only Python writes to standard error: what libraries in C say of a file is said in our own line."""
    stderr = sys.__stderr__
    if shows_traceback() or stderr is None or sys.stderr is not stderr:
        return
    if not sys.warnoptions:
        warnings.simplefilter("ignore")
    spoken = os.fdopen(os.dup(2), "w", 1, stderr.encoding, stderr.errors)
    with Path(os.devnull).open("wb") as nowhere:
        os.dup2(nowhere.fileno(), 2)
    sys.stderr = spoken
    faulthandler.enable(spoken)  # what a library says before it crashes is not seen either


def _checked(words: Sequence[str], name: str) -> list[str]:
    """The words with ``~`` and ``~/`` as the home folder.

    An empty one, as of a shell variable that is not set, is refused.
    """
    checked = []
    for before, word in zip(["", *words], words):
        option = _OPTION.match(word)
        start, value = (option.group(), word[option.end() :]) if option else ("", word)
        if not value and before not in _MAY_BE_EMPTY and start not in _MAY_BE_EMPTY:
            where = start.rstrip("=") or (before if before.startswith("--") else "one of its words")
            _end(f"{name}: {where} is empty: give a value or leave it out (is a shell variable not set?)", 2)
        checked.append(start + (str(Path(value).expanduser()) if value == "~" or value.startswith("~/") else value))
    return checked


def _end(line: str, code: int) -> NoReturn:
    _say(line)
    sys.exit(code)


def _say(line: str) -> None:
    with suppress(OSError, ValueError):  # nobody is listening
        typer.echo(line, err=True)
