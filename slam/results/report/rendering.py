"""Pages of HTML from the templates beside this file: one file each, which opens offline and asks for nothing."""

from __future__ import annotations

import base64
import gzip
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any

from jinja2 import Environment, PackageLoader, StrictUndefined

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

_TEMPLATES = Environment(
    loader=PackageLoader("slam", "results/report"),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
    keep_trailing_newline=True,
)


@dataclass(frozen=True)
class Picture:
    """An image, a plot as Plotly's JSON, or the ``reason`` why it could not be drawn; ``image`` is its address."""

    title: str
    caption: str
    image: str = ""
    plot: str = ""
    reason: str = ""

    @classmethod
    def of_file(cls, title: str, caption: str, content: bytes, kind: str) -> Picture:
        """A file of a ``kind`` such as png."""
        return cls(title, caption, image=address_of(content, kind))

    @classmethod
    def of_plot(cls, title: str, caption: str, figure: Figure) -> Picture:
        """A plot that page.js draws, in the colours of the page."""
        figure.update_layout(template={})
        return cls(title, caption, plot=str(figure.to_json()).replace("<", "\\u003c"))


def render(template: str, **values: Any) -> str:
    """A page; it holds Plotly where it has a plot."""
    script = (files("slam.results.report") / "viewer" / "page.js").read_text("utf-8")
    return _TEMPLATES.get_template(template).render(script=script, plotly=_plotly, **values)


def address_of(content: bytes, kind: str) -> str:
    """An image file as the address of itself."""
    return f"data:image/{kind};base64,{base64.b64encode(content).decode('ascii')}"


def packed(content: bytes) -> str:
    """What ``unpacked`` of page.js reads."""
    return base64.b64encode(gzip.compress(content, 6, mtime=0)).decode("ascii")


@cache
def _plotly() -> str:
    from plotly.offline import get_plotlyjs

    return packed(get_plotlyjs().encode())
