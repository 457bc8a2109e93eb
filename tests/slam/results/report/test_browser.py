"""The report in a browser that asks for nothing: every plot is drawn, and the map turns with the mouse."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from slam.results.folder import RunFolder
from slam.results.report.figures import MapView
from slam.results.report.page import write_report

MakeRun = Callable[..., RunFolder]
CHROMIUM = (
    shutil.which("chromium")
    or shutil.which("chromium-browser")
    or shutil.which("google-chrome")
    or ""
)
FLAGS = (
    *(
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--disable-quic",
        "--no-first-run",
        "--hide-scrollbars",
    ),
    *(
        "--disable-background-networking",
        "--disable-component-update",
        "--disable-sync",
        "--disable-default-apps",
    ),
    *(
        "--use-gl=angle",
        "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader",
        "--enable-logging=stderr",
    ),
    *(
        "--window-size=640,480",
        "--virtual-time-budget=12000",
        "--host-resolver-rules=MAP * ~NOTFOUND",
    ),
)
SLOW = re.compile(
    "GPU stall due to ReadPixels|willReadFrequently"
)  # of the screenshot, and of words in a scene
browser = pytest.mark.skipif(not CHROMIUM, reason="no Chromium is installed")


@pytest.fixture
def report(make_run: MakeRun, view: MapView) -> Path:
    folder = make_run()
    write_report(folder, view=view)
    return folder.path / "report.html"


def browse(page: Path, *options: str) -> tuple[str, list[str]]:
    """Standard output of the browser, and the lines of its console."""
    profile = f"--user-data-dir={page.parent / 'profile'}"
    command = [CHROMIUM, *FLAGS, profile, *options, page.as_uri()]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    lines = [
        line for line in ended.stderr.splitlines() if "CONSOLE" in line and not SLOW.search(line)
    ]
    return ended.stdout, lines


def changed(report: Path, name: str, extra: str) -> Path:
    """The page with something at its end."""
    page = report.with_name(name)
    page.write_text(report.read_text("utf-8").replace("</body>", f"{extra}</body>"), "utf-8")
    return page


@browser
def test_every_plot_is_drawn_and_nothing_offers_to_send_it(report: Path) -> None:
    page, console = browse(report, "--dump-dom")
    assert console == []
    assert page.count('class="plot"') == page.count('class="modebar-container"') == 5
    titles = set(re.findall('data-title="([^"]*)"', page))
    of_map = {"Orbital rotation", "Reset camera to default"}
    assert titles == {"Zoom", "Pan", "Reset axes", "Download plot as a PNG"} | of_map


DRAG = """<script>setTimeout(async () => {
  const plot = [...document.querySelectorAll(".plot > div")].find(each => each.layout?.scene);
  const scene = plot._fullLayout.scene._scene, canvas = scene.glplot.canvas, place = canvas.getBoundingClientRect();
  const camera = () => JSON.stringify(scene.getCamera()), before = camera();
  const at = k => ({ bubbles: true, clientX: place.left + 200 + 10 * k, clientY: place.top + 200 });
  const mouse = (kind, k) => canvas.dispatchEvent(new MouseEvent(kind, { ...at(k), buttons: +(kind != "mouseup") }));
  mouse("mousedown", 0);
  for (let k = 1; k < 16; k++) { mouse("mousemove", k); await new Promise(done => setTimeout(done, 50)); }
  mouse("mouseup", 16);
  document.title = camera() === before ? "stands" : "turned";
}, 4000)</script>"""


@browser
def test_the_map_turns_with_the_mouse(report: Path) -> None:
    page, console = browse(changed(report, "turned.html", DRAG), "--dump-dom")
    assert console == [] and "<title>turned</title>" in page


@browser
def test_a_request_of_the_page_would_be_refused_and_said(report: Path) -> None:
    picture = '<img alt="" src="http://127.0.0.1:9/picture.png">'
    _, console = browse(changed(report, "asking.html", picture), "--dump-dom")
    assert len(console) == 1 and "Content Security Policy" in console[0]
