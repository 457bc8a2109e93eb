"""Code of both command lines: it turns every error into one line and an exit code."""

from __future__ import annotations

import logging
import os
import sys
import warnings
from collections.abc import Callable
from contextlib import suppress
from io import TextIOWrapper
from typing import Annotated, Literal, TextIO

import typer

from erfsfm import __version__
from erfsfm.common.errors import explained, shows_traceback
from erfsfm.common.signals import Terminated

# what they would say of a file is said in our own line
_OPENCV = {"OPENCV_LOG_LEVEL": "SILENT", "OPENCV_FFMPEG_LOGLEVEL": "-8"}
_INTERRUPTED = 130  # exit code that typer gives to ctrl-C


Device = Annotated[Literal["auto", "cpu", "cuda"], typer.Option(help="where the networks run")]
Seed = Annotated[int, typer.Option(min=0, max=2**31 - 1, help="seed of every random draw")]
Overrides = Annotated[list[str] | None, typer.Option("--set", help="section.key=value; repeat")]
Json = Annotated[bool, typer.Option("--json", help="print JSON instead of a table")]
# every verb that computes takes both; in one that draws nothing and runs no network they change nothing
UnusedDevice = Annotated[Literal["auto", "cpu", "cuda"], typer.Option("--device", hidden=True)]
UnusedSeed = Annotated[int, typer.Option("--seed", hidden=True)]


class Terminal(logging.StreamHandler[TextIO]):
    """Standard error, to which a warning of one kind is said once: a damaged drive has thousands."""

    def __init__(self, level: int) -> None:
        super().__init__(sys.stderr)
        self.setLevel(level)
        self._said: set[str] = set()
        logging.basicConfig(
            level=level, format="%(levelname)s %(name)s: %(message)s", handlers=[self]
        )

    def emit(self, record: logging.LogRecord) -> None:
        """Say a record, unless it is a warning and one like it was said."""
        if record.levelno != logging.WARNING or record.msg not in self._said:
            self._said.add(record.msg)
            super().emit(record)


def application(name: str, about: str) -> typer.Typer:
    """A program of several verbs: plain help, since markup would lose what stands in brackets, and ``--version``."""
    app = typer.Typer(
        no_args_is_help=True, rich_markup_mode=None, pretty_exceptions_enable=False, help=about
    )

    def print_version(wanted: bool) -> None:
        if wanted:
            typer.echo(f"{name} {__version__}")
            raise typer.Exit

    @app.callback()
    def of_all_verbs(
        version: bool = typer.Option(
            False,
            "--version",
            callback=print_version,
            is_eager=True,
            help="print the version and exit",
        ),
        quiet: bool = typer.Option(False, "--quiet", "-q", help="no warnings on the terminal"),
        verbose: bool = typer.Option(False, "--verbose", "-v", help="say there what the log says"),
    ) -> None:
        root = logging.getLogger()
        if quiet or verbose:
            root.setLevel(logging.ERROR if quiet else logging.INFO)
            for handler in root.handlers:
                handler.setLevel(root.level)

    return app


def run(app: Callable[..., object], name: str, level: int) -> None:
    """Run a command line on ``sys.argv`` that logs from a ``level`` on.

    A known error becomes one line on stderr and exit code 1.
    """
    for variable, value in {"OMP_WAIT_POLICY": "PASSIVE", **_OPENCV}.items():
        os.environ.setdefault(variable, value)
    if not shows_traceback() and not sys.warnoptions:
        warnings.simplefilter("ignore")
    for stream in (sys.stdout, sys.stderr):  # a terminal in ASCII has no sign for every name
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="replace")
    Terminal(level)
    try:
        app(args=sys.argv[1:], prog_name=name)
    except SystemExit as end:
        if end.code == _INTERRUPTED or isinstance(end, Terminated):
            _say(
                f"{name}: {end if isinstance(end, Terminated) else 'interrupted'}; what was written stays"
            )
        raise
    except Exception as error:  # the last place where an error can become one line
        if shows_traceback():
            raise
        _say(f"{name}: {explained(error)}")
        sys.exit(1)


def _say(line: str) -> None:
    with suppress(OSError, ValueError):  # nobody is listening
        typer.echo(line, err=True)
