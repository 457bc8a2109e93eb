"""Code of both command lines: it turns every error into one line and an exit code."""

from __future__ import annotations

import io
import logging
import os
import re
import sys
import warnings
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TextIO

import typer

from erfsfm import __version__
from erfsfm.common.errors import explained, shows_traceback
from erfsfm.common.signals import Terminated

# what they would say of a file is said in our own line
_OPENCV = {"OPENCV_LOG_LEVEL": "SILENT", "OPENCV_FFMPEG_LOGLEVEL": "-8"}
_INTERRUPTED = 130  # exit code that typer gives to ctrl-C
_HOME = re.compile(r"^(--[a-z-]+=)?~(?=/|$)")


class Terminal(logging.StreamHandler[TextIO]):
    """Standard error, to which a warning of one kind is said once, and at the end how often besides."""

    def __init__(self, level: int) -> None:
        super().__init__(sys.stderr)
        self.setLevel(level)
        self._times: Counter[str] = Counter()
        logging.basicConfig(level=level, format="%(levelname)s %(name)s: %(message)s", handlers=[self])

    def emit(self, record: logging.LogRecord) -> None:
        """Say a record, unless one like it was said."""
        kind = f"{record.name}: {record.msg}"
        self._times[kind] += record.levelno == logging.WARNING
        if self._times[kind] <= 1:
            super().emit(record)

    def count(self) -> None:
        """Say what was not said."""
        for kind, times in self._times.items():
            if times > 1:
                _say(f"WARNING {kind.partition(':')[0]}: {times - 1} more warnings of this kind")


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
    if not shows_traceback():
        _quieten_libraries()
    terminal = Terminal(level)
    # the shell leaves ~ in --output=~/runs
    words = [_HOME.sub(lambda match: f"{match[1] or ''}{Path.home()}", word) for word in sys.argv[1:]]
    try:
        try:
            app(args=words, prog_name=name)
        finally:  # the last line is that of the error
            terminal.count()
    except SystemExit as end:
        if end.code == _INTERRUPTED or isinstance(end, Terminated):
            why = str(end) if isinstance(end, Terminated) else "interrupted"
            _say(f"{name}: {why}; what was written stays")
        raise
    except Exception as error:  # the last place where an error can become one line
        if shows_traceback():
            raise
        _say(f"{name}: {explained(error)}")
        sys.exit(1)


def _quieten_libraries() -> None:
    """Only Python writes to standard error: what libraries in C say of a damaged file is said in our own line."""
    if not sys.warnoptions:
        warnings.simplefilter("ignore")
    stderr = sys.stderr
    if isinstance(stderr, io.TextIOWrapper) and stderr is sys.__stderr__:
        spoken = os.fdopen(os.dup(2), "w", 1, stderr.encoding, stderr.errors)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        sys.stderr = spoken


def _say(line: str) -> None:
    with suppress(OSError, ValueError):  # nobody is listening
        typer.echo(line, err=True)
