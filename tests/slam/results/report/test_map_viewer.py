"""The map in the report: packed without loss, drawn by a browser that asks for nothing, replaced by its picture."""

from __future__ import annotations

import base64
import gzip
import json
import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread
from numpy.typing import NDArray

from slam.formats.ply import Ply
from slam.geometry.se3 import FloatArray
from slam.results.folder import RunFolder
from slam.results.report.map_mesh import MapMesh
from slam.results.report.map_view import MapViews, map_viewer
from slam.results.report.page import write_report

MakeRun = Callable[..., RunFolder]
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome") or ""
FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--hide-scrollbars"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync", "--disable-default-apps"),
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--enable-logging=stderr"),
    *("--window-size=640,480", "--virtual-time-budget=8000", "--host-resolver-rules=MAP * ~NOTFOUND"),
)
READBACK = "GPU stall due to ReadPixels"  # of the screenshot itself
ONLY_CANVAS = (
    "<style>body * { visibility: hidden } .viewer.live canvas { visibility: visible; position: fixed }</style>"
)
browser = pytest.mark.skipif(not CHROMIUM, reason="no Chromium is installed")


def test_what_is_packed_is_the_mesh(plain: Ply) -> None:
    assert plain.colours is not None and plain.triangles is not None
    mesh = MapMesh(plain.points, plain.colours, plain.triangles)
    T_world_camera = np.tile(np.eye(4), (3, 1, 1))
    viewer = map_viewer(mesh, T_world_camera, 1)
    about = json.loads(viewer.about)
    content = gzip.decompress(base64.b64decode(viewer.mesh))
    count, ends = about["vertices"], np.cumsum([6 * about["vertices"], 3 * about["vertices"], about["padding"]])
    points = np.frombuffer(content[: ends[0]], "<u2").reshape(-1, 3) * about["step"] + about["low"]
    colours = np.frombuffer(content[ends[0] : ends[1]], "u1").reshape(count, 3)
    corners = np.cumsum(np.frombuffer(content[ends[2] :], "<i4")).reshape(-1, 3)

    def soup(points: FloatArray, colours: NDArray[np.uint8], corners: NDArray[np.int64]) -> FloatArray:
        """The corners of all triangles with their colours, sorted by triangle."""
        whole = np.concatenate([points.round(1), colours], axis=1)[corners].reshape(-1, 18)
        return whole[np.lexsort(whole.T)]

    assert about["triangles"] == len(corners) == len(plain.triangles)
    y_up = plain.points * [1.0, -1.0, -1.0]
    assert np.allclose(soup(points, colours, corners), soup(y_up, plain.colours, plain.triangles), atol=0.11)
    assert about["seat"] == [0.0, 0.0, 0.0] and about["ahead"] == [0.0, 0.0, -12.0]


@pytest.fixture
def report(make_run: MakeRun, map_views: MapViews) -> Path:
    folder = make_run()
    write_report(folder, views=map_views)
    return folder.path / "report.html"


def browse(page: Path, *options: str) -> tuple[str, list[str]]:
    """Standard output of the browser, and the lines of its console."""
    profile = f"--user-data-dir={page.parent / 'profile'}"
    command = [CHROMIUM, *FLAGS, profile, *options, page.as_uri()]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    lines = [line for line in ended.stderr.splitlines() if "CONSOLE" in line and READBACK not in line]
    return ended.stdout, lines


def changed(report: Path, name: str, extra: str) -> Path:
    """The page with something at its end."""
    page = report.with_name(name)
    page.write_text(report.read_text("utf-8").replace("</body>", f"{extra}</body>"), "utf-8")
    return page


def canvas_after(report: Path, action: str) -> NDArray[np.float32]:
    """The canvas alone, after ``action`` on a live viewer, as ``(H, W, 3)``."""
    wait = f"const wait = () => figure.classList.contains('live') ? ({action}) : setTimeout(wait, 50)"
    script = f"<script>(() => {{ const figure = document.getElementById('map-viewer'); {wait}; wait() }})()</script>"
    picture = report.with_name("canvas.png")
    _, console = browse(changed(report, "canvas.html", ONLY_CANVAS + script), f"--screenshot={picture}")
    assert console == []
    return imread(picture)[..., :3]


@browser
def test_it_draws_and_turns_without_a_word_on_the_console(report: Path) -> None:
    seat = canvas_after(report, "0")
    assert seat.std() > 0.1 and len(np.unique((255 * seat).round().reshape(-1, 3), axis=0)) > 50
    above = canvas_after(report, "figure.querySelector('[data-view=above]').click()")
    keys = "new KeyboardEvent('keydown', {code: 'ArrowLeft', shiftKey: true, bubbles: true})"
    turned = canvas_after(report, f"figure.querySelector('canvas').dispatchEvent({keys})")
    for other in (above, turned):
        assert abs(other - seat).mean() > 0.02


@browser
def test_every_plot_is_drawn_and_nothing_offers_to_send_it(report: Path) -> None:
    page, console = browse(report, "--dump-dom")
    assert console == []
    assert page.count('class="plot"') == page.count('class="modebar-container"') == 6
    titles = set(re.findall('data-title="([^"]*)"', page))
    assert titles == {"Zoom", "Pan", "Reset axes", "Download plot as a PNG"}


@browser
def test_a_request_of_the_page_would_be_refused_and_said(report: Path) -> None:
    picture = '<img alt="" src="http://127.0.0.1:9/picture.png">'
    _, console = browse(changed(report, "asking.html", picture), "--dump-dom")
    assert len(console) == 1 and "Content Security Policy" in console[0]


@browser
def test_without_webgl_the_picture_stands(report: Path) -> None:
    page, _ = browse(report, "--disable-3d-apis", "--dump-dom")
    assert "The map cannot be turned here: WebGL 2 is not available." in page
    assert 'class="viewer"' in page and 'class="viewer live"' not in page
