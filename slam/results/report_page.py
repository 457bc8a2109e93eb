"""A self-contained HTML page: escaped text, tables and pictures, without scripts and without a network."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

_STYLE = """
:root { --ink: #1b1f24; --soft: #59636e; --line: #d8dde3; --wash: #f5f7f9; --accent: #0072b2; --bad: #b3261e; }
* { box-sizing: border-box; }
body { margin: 0; background: #fff; color: var(--ink);
  font: 15px/1.5 system-ui, "Segoe UI", Roboto, "DejaVu Sans", Helvetica, Arial, sans-serif; }
main { max-width: 1080px; margin: 0 auto; padding: 28px 28px 56px; }
h1 { font-size: 28px; line-height: 1.2; margin: 0; letter-spacing: -0.01em; overflow-wrap: anywhere; }
h2 { font-size: 19px; margin: 40px 0 12px; padding-bottom: 6px; border-bottom: 1px solid var(--line); }
h3 { font-size: 15px; margin: 22px 0 8px; }
p { margin: 8px 0; }
a { color: var(--accent); }
code { font: 13px/1.45 ui-monospace, "DejaVu Sans Mono", Menlo, Consolas, monospace; overflow-wrap: anywhere; }
.kicker { color: var(--soft); font-size: 12px; letter-spacing: 0.08em; text-transform: uppercase; margin: 0 0 4px; }
.soft, figcaption, .note { color: var(--soft); font-size: 13px; }
.stamp { margin: 18px 0 0; padding: 10px 16px; border: 2px solid var(--bad); border-left-width: 8px;
  color: var(--bad); border-radius: 4px; }
.stamp b { letter-spacing: 0.06em; margin-right: 8px; }
.hint { margin: 18px 0 0; padding: 10px 16px; background: var(--wash); border-left: 4px solid var(--accent);
  border-radius: 4px; }
.cards { display: grid; grid-template-columns: repeat(auto-fit, minmax(122px, 1fr)); gap: 10px; margin: 22px 0 0; }
.card { border: 1px solid var(--line); border-radius: 6px; padding: 9px 12px; }
.card .name { color: var(--soft); font-size: 12.5px; }
.card .value { font-size: 20px; line-height: 1.3; font-variant-numeric: tabular-nums; }
.card .unit { font-size: 12px; color: var(--soft); }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; margin: 10px 0; }
th, td { padding: 5px 12px; text-align: right; vertical-align: top; border-bottom: 1px solid #e9ecf0; }
th:first-child, td:first-child { text-align: left; }
thead th { border-bottom: 2px solid var(--ink); font-weight: 600; white-space: nowrap; vertical-align: bottom; }
tr.group th { text-align: left; padding-top: 14px; color: var(--soft); font-weight: 600; font-size: 13px; }
table.words th, table.words td { text-align: left; }
table.words td:first-child { color: var(--soft); width: 170px; white-space: nowrap; }
td.best { font-weight: 700; }
td.missing { color: #8b949e; cursor: help; }
.bar { display: block; height: 12px; margin-top: 5px; background: var(--accent); border-radius: 2px;
  min-width: 1px; print-color-adjust: exact; -webkit-print-color-adjust: exact; }
td.track { width: 55%; }
figure { margin: 12px auto 22px; max-width: 860px; }
figure img { display: block; width: 100%; height: auto; }
figcaption { margin-top: 4px; }
footer { margin-top: 44px; padding-top: 10px; border-top: 1px solid var(--line); }
@media print {
  @page { margin: 14mm; }
  body { font-size: 11px; }
  main { max-width: none; padding: 0; }
  h2 { break-after: avoid; margin-top: 22px; }
  figure, tr, .cards, .stamp, .hint { break-inside: avoid; }
  a { color: inherit; }
}
"""


@dataclass(frozen=True)
class Cell:
    """A table cell: its text, a tooltip, and a style (``best``, ``missing``)."""

    text: str
    tooltip: str = ""
    style: str = ""

    def html(self) -> str:
        """The cell as ``<td>``."""
        style = f' class="{escape(self.style)}"' if self.style else ""
        return f"<td{style}{_title(self.tooltip)}>{escape(self.text)}</td>"


Row = Sequence[Cell | str]


def page(title: str, body: Iterable[str]) -> str:
    """A whole document from ready pieces of HTML."""
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{_STYLE}</style>\n</head>\n<body>\n<main>\n"
        + "\n".join(body)
        + "\n</main>\n</body>\n</html>\n"
    )


def section(title: str, *pieces: str) -> str:
    """A headed section of ready pieces, or nothing where all of them are empty."""
    filled = [piece for piece in pieces if piece]
    return "\n".join(["<section>", f"<h2>{escape(title)}</h2>", *filled, "</section>"]) if filled else ""


def text(words: str, style: str = "") -> str:
    """A paragraph of plain words."""
    return f'<p class="{escape(style)}">{escape(words)}</p>' if style else f"<p>{escape(words)}</p>"


def stamp(mark: str, words: str) -> str:
    """A red box that cannot be missed."""
    return f'<div class="stamp" role="alert"><b>{escape(mark)}</b>{escape(words)}</div>'


def hint(words: str) -> str:
    """A box for what a reader must know before the numbers."""
    return f'<div class="hint">{escape(words)}</div>'


def cards(entries: Iterable[tuple[str, Cell, str]]) -> str:
    """Key numbers: (name, value, unit) each."""
    boxes = "\n".join(
        f'<div class="card"{_title(cell.tooltip)}><div class="name">{escape(name)}</div>'
        f'<div class="value">{escape(cell.text)} <span class="unit">{escape(unit)}</span></div></div>'
        for name, cell, unit in entries
    )
    return f'<div class="cards">\n{boxes}\n</div>'


def table(head: Sequence[str], rows: Iterable[Row | str], style: str = "") -> str:
    """A table; a row that is a string heads a group of rows."""
    lines = [f'<table class="{escape(style)}">' if style else "<table>"]
    if head:
        lines.append("<thead><tr>" + "".join(f"<th>{escape(name)}</th>" for name in head) + "</tr></thead>")
    lines.append("<tbody>")
    for row in rows:
        if isinstance(row, str):
            lines.append(f'<tr class="group"><th colspan="{len(head)}">{escape(row)}</th></tr>')
        else:
            cells = (cell if isinstance(cell, Cell) else Cell(cell) for cell in row)
            lines.append("<tr>" + "".join(cell.html() for cell in cells) + "</tr>")
    return "\n".join([*lines, "</tbody>", "</table>"])


def bars(head: Sequence[str], rows: Iterable[tuple[str, str, str, float]]) -> str:
    """A table of (name, words, words, share of 1) with each share drawn as a bar."""
    names = "".join(f"<th>{escape(name)}</th>" for name in head)
    lines = ["<table>", f"<thead><tr>{names}<th></th></tr></thead>", "<tbody>"]
    for *words, share in rows:
        cells = "".join(f"<td>{escape(word)}</td>" for word in words)
        width = 100.0 * min(max(share, 0.0), 1.0)
        bar = f'<span class="bar" style="width: {width:.1f}%"></span>'
        lines.append(f'<tr>{cells}<td class="track">{bar}</td></tr>')
    return "\n".join([*lines, "</tbody>", "</table>"])


def links(entries: Iterable[tuple[str, str, str, str]]) -> str:
    """A table of files: (address, name, meaning, size) each."""
    rows = "\n".join(
        f'<tr><td><a href="{escape(address)}"><code>{escape(name)}</code></a></td>'
        f"<td>{escape(meaning)}</td><td>{escape(size)}</td></tr>"
        for address, name, meaning, size in entries
    )
    return f'<table class="words">\n<tbody>\n{rows}\n</tbody>\n</table>'


def picture(figure: Any, alternative: str, caption: str = "") -> str:
    """A Matplotlib figure as a PNG inside the page."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=160, metadata={"Software": None})
    data = base64.b64encode(buffer.getvalue()).decode("ascii")
    words = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
    return f'<figure><img alt="{escape(alternative)}" src="data:image/png;base64,{data}">{words}</figure>'


def _title(tooltip: str) -> str:
    return f' title="{escape(tooltip)}"' if tooltip else ""
