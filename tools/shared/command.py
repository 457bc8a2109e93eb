"""What the tools share: parsers, errors as one line, Markdown tables."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager

from erfsfm.common.errors import OneLineError


def parser_of(doc: str | None) -> argparse.ArgumentParser:
    """A parser whose help begins with the docstring of a tool."""
    return argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)


@contextmanager
def one_line_errors() -> Iterator[None]:
    """End with the line of a known error and exit code 1; also a decorator."""
    try:
        yield
    except OneLineError as error:
        raise SystemExit(str(error)) from error


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]], numbers: int = 0) -> str:
    """A table in Markdown; its last ``numbers`` columns are aligned to the right."""
    rule = "|" + "---|" * (len(head) - numbers) + "---:|" * numbers
    first, *others = (f"| {' | '.join(cells)} |" for cells in (head, *rows))
    return "\n".join([first, rule, *others])
