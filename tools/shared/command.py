"""What the tools share: parsers, and errors as one line."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager

from erfsfm.common.errors import OneLineError


def parser_of(doc: str | None) -> argparse.ArgumentParser:
    """A parser whose help begins with the docstring of a tool."""
    return argparse.ArgumentParser(
        description=doc, formatter_class=argparse.RawDescriptionHelpFormatter
    )


@contextmanager
def one_line_errors() -> Iterator[None]:
    """End with the line of a known error and exit code 1; also a decorator."""
    try:
        yield
    except OneLineError as error:
        raise SystemExit(str(error)) from error
