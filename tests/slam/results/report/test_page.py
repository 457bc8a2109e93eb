"""The report is one valid, complete and self-contained page, whose pictures show what they say."""

from __future__ import annotations

import base64
import json
import re
import shutil
import subprocess
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from slam.frames import LOOP_SOURCE, Intrinsics, RelativePose
from slam.loops.verification import Loop
from slam.mapping.depth import KeyframeDepth
from slam.results.folder import RunFolder
from slam.results.report.figures import MapView
from slam.results.report.page import (
    DepthPictures,
    Picture,
    fixed_pictures,
    loop_pictures,
    write_report,
)

MakeRun = Callable[..., RunFolder]
MakeMetrics = Callable[..., dict[str, Any]]

VOID = {"meta", "img", "br", "hr", "link", "input"}
CHROMIUM = (
    shutil.which("chromium")
    or shutil.which("chromium-browser")
    or shutil.which("google-chrome")
    or ""
)
FLAGS = (
    "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --hide-scrollbars "
    "--disable-background-networking --disable-component-update --disable-sync "
    "--disable-default-apps --use-gl=angle --use-angle=swiftshader --enable-unsafe-swiftshader "
    "--enable-logging=stderr --window-size=640,480 --virtual-time-budget=12000"
)
NO_HOSTS = "--host-resolver-rules=MAP * ~NOTFOUND"
SLOW = re.compile(
    "GPU stall due to ReadPixels|willReadFrequently"
)  # of the screenshot, and of words in a scene
browser = pytest.mark.skipif(not CHROMIUM, reason="no Chromium is installed")
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


class Balance(HTMLParser):
    """Collects text, tags and every opening tag without its end."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words.append(data)


def parsed(folder: RunFolder) -> tuple[str, Balance]:
    html = (folder.path / "report.html").read_text(encoding="utf-8")
    balance = Balance()
    balance.feed(html)
    balance.close()
    assert balance.open == []
    assert html.startswith("<!DOCTYPE html>")
    return html, balance


def plots(html: str) -> dict[str, Any]:
    """Every plot by its title, as Plotly gets it."""
    found = re.findall(
        r'<figure class="plot"><h3>([^<]*)</h3>.*?<script type="application/json">(.*?)</script>',
        html,
        re.S,
    )
    return {title: json.loads(plot) for title, plot in found}


def surface_corners(surface: dict[str, Any]) -> np.ndarray:
    return np.stack([values(surface[axis], "u2") for axis in "ijk"])


def values(packed: dict[str, str], kind: str) -> np.ndarray:
    assert packed["dtype"] == kind
    return np.frombuffer(base64.b64decode(packed["bdata"]), kind)


@pytest.fixture
def full(make_run: MakeRun, view: MapView) -> RunFolder:
    folder = make_run()
    strip = Picture("Frame 10", "Frame 10", "data:image/jpeg;base64,YSBwaWN0dXJl")
    write_report(folder, [strip], [], view)
    return folder


def test_a_full_report_is_balanced_and_needs_no_network(full: RunFolder):
    html, balance = parsed(full)
    without_data = re.sub(r"[\w+/=]{200,}", "", html)
    assert not re.search(r'https?:|@import|url\(|src="(?!data:)|<link', without_data)
    (policy,) = [
        attrs["content"]
        for _, attrs in balance.tags
        if attrs.get("http-equiv") == "Content-Security-Policy"
    ]
    assert str(policy).startswith("default-src 'none'")
    addresses = [attrs["href"] for tag, attrs in balance.tags if tag == "a"]
    assert addresses
    assert all((full.path / str(address)).is_file() for address in addresses)
    assert not list(full.path.glob(".*"))


def test_its_plots_have_the_numbers_of_the_run(full: RunFolder):
    html, balance = parsed(full)
    assert [attrs["alt"] for tag, attrs in balance.tags if tag == "img"] == ["Frame 10"]
    found = plots(html)
    assert list(found) == [
        "Trajectories from above",
        "Scale and rotation over time",
        "Position error along the path",
        "Drift by the length of segments",
        "Map",
    ]
    lines = {line["name"]: line for line in found["Position error along the path"]["data"]}
    assert list(lines) == ["Network, chained", "Odometry", "Optimised"]
    assert (
        values(lines["Optimised"]["y"], "f4").max()
        < values(lines["Network, chained"]["y"], "f4").max()
    )
    assert values(lines["Optimised"]["customdata"], "i4").tolist() == list(range(300))
    (scale, *_) = (
        line
        for line in found["Scale and rotation over time"]["data"]
        if line["name"] == "Optimised"
    )
    assert values(scale["y"], "f4") == pytest.approx(1.01, abs=0.002)
    surface, path = found["Map"]["data"]
    assert (surface["type"], path["type"]) == ("mesh3d", "scatter3d")
    assert (
        len(surface["vertexcolor"])
        == len(values(surface["x"], "f4"))
        > surface_corners(surface).max()
    )
    assert values(path["y"], "f4").tolist() == list(range(60))  # ahead
    assert values(surface["z"], "f4").min() == pytest.approx(-1.65, abs=0.01)  # the ground is below
    assert html.count('id="plotly"') == 1


def test_it_shows_the_inputs_of_the_run_escaped(full: RunFolder):
    html, balance = parsed(full)
    words = " ".join(balance.words)
    for said in (
        "sim/loop <42>",
        "MIT: trained on our own",
        "erfsfm-slam run --sequence '<b>09</b>' & more",
    ):
        assert said in words
    assert "mode camera-height: one unit of the networks is 1.65 metres" in words
    assert "<b>09" not in html
    assert "<b>too small" not in html
    assert "LEAK" not in html


def test_the_first_sentence_says_how_good_it_is_and_why(
    make_run: MakeRun, make_metrics: MakeMetrics
):
    def said(**changed: Any) -> str:
        folder = make_run(metrics=make_metrics() | changed)
        write_report(folder)
        return " ".join(" ".join(parsed(folder)[1].words).split())

    good = said()
    assert (
        "2.6 m off the truth (RMSE, 0.87 % of its 299 m)" in good
        and "1 of 3 measured loops agree" in good
    )
    assert (
        "47, 88, 93 % of its measurements" in good and "Doubts: lengths are 11 % too short." in good
    )
    contradicted = [{"source": "lidar", "sigmas": 3.2, "figure": "its steps turn otherwise"}]
    doubtful = said(
        agreement=contradicted,
        loops={"candidates": 9, "verified": 0, "accepted": 0, "rejected": []},
    )
    assert (
        "no loop closes it (9 candidates)" in doubtful
        and "lidar contradicts the images" in doubtful
    )
    unknown = said(**make_metrics(reference=False, mode="none"), confidence={"run": 0.97})
    assert "its error is unknown: 97 % of drives like it" in unknown
    unsaid = said(confidence={"run": None, "run_reason": "the camera is carried"})
    of_shape = said(confidence={"run": None, "shape": 0.9, "shape_within": 0.03})
    assert "90 % of drives with images like its own err in shape" in str(of_shape)
    assert "the camera is carried" in unsaid and "of drives" not in unsaid


def test_a_map_of_scraps_is_no_success(make_run: MakeRun, make_metrics: MakeMetrics):
    scraps = make_metrics()["map"] | {
        "triangles": 19908,
        "frames_fused": 40,
        "filters": {"range": 0.7, "sky": 0.263},
    }
    folder = make_run(metrics=make_metrics() | {"map": scraps})
    write_report(folder)
    words = " ".join(" ".join(parsed(folder)[1].words).split())
    assert (
        "its map is scraps: 3.7 % of the depth" in words and "by the filter range (70 %)" in words
    )
    assert "Map triangles" not in words and "SCRAPS" in words


def test_a_leak_is_stamped(make_run: MakeRun, make_metrics: MakeMetrics):
    folder = make_run(metrics=make_metrics(leak=True))
    write_report(folder)
    html, _ = parsed(folder)
    assert '<div class="stamp" role="alert"><b>LEAK</b>' in html


def test_without_reference_and_map_the_report_has_the_reasons(
    make_run: MakeRun, make_metrics: MakeMetrics
):
    metrics = make_metrics(reference=False, mode="none")
    metrics |= {"map": None, "map_reason": "fusion is switched off"}
    metrics["loops"] = {
        "candidates": None,
        "candidates_reason": "this part is not built yet",
        "rejected": [],
    }
    folder = make_run(metrics=metrics, reference=False)
    write_report(folder)
    html, balance = parsed(folder)
    words = " ".join(balance.words)
    assert "No errors: the sequence has no true poses" in words
    assert "No map: fusion is switched off" in words
    assert "this part is not built yet" in words
    assert "camera heights" in words
    assert list(plots(html)) == ["Trajectories from above", "Speed and rotation over time"]
    assert "Position error" not in words and "every alignment" not in words, (
        "no numbers that are dashes alone"
    )


def test_a_failed_run_has_its_reason(make_run: MakeRun):
    metrics = {"schema": 1, "status": "failed", "reason": "frame 7 <is> broken", "provenance": None}
    folder = make_run(metrics=metrics, reference=False)
    for path in folder.path.glob("trajectory_*"):
        path.unlink()
    write_report(folder)
    html, balance = parsed(folder)
    assert "frame 7 <is> broken" in balance.words
    assert "No trajectory was written" in html
    assert "FAILED" in html


def pixels(picture: Picture) -> NDArray[np.uint8]:
    """``(H, W, 3)``, BGR."""
    content = base64.b64decode(picture.image.removeprefix("data:image/jpeg;base64,"))
    return np.asarray(cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR))


def test_lines_join_the_corners_of_the_loop():
    first, second = (np.full((64, 208, 3), 128, np.uint8) for _ in range(2))
    camera = Intrinsics(416, 128, 200.0, 200.0, 208.0, 64.0)  # of images twice as large
    corners = np.array([[[104.0, 64.0], [312.0, 32.0]]], np.float32)
    loop = Loop(
        RelativePose(4, 6, np.eye(4), np.full(6, 0.1), LOOP_SOURCE), 50, 0.9, pixels=corners
    )
    (picture,) = loop_pictures([loop], {4: first, 6: second}.get, camera)
    assert picture.title == "Frames 4 and 6: 50 inliers"
    shown = pixels(picture).astype(int)
    assert shown.shape == (2 * 148, 480, 3)
    drawn = np.argwhere(np.abs(shown - 128).max(axis=-1) > 60)
    assert drawn.min(axis=0) == pytest.approx([74, 120], abs=4)
    assert drawn.max(axis=0) == pytest.approx([148 + 37, 360], abs=4)
    assert loop_pictures([loop], {4: first}.get, camera) == []  # the image of a live drive is gone


def test_near_is_bright_and_unknown_is_dark():
    pictures, image = DepthPictures(60), np.full((40, 120, 3), 128, np.uint8)
    learned = np.full((40, 120), 50.0, np.float32)
    refined = learned.copy()
    refined[:, :40], refined[:, 80:] = 2.0, 0.0
    for frame in range(0, 60, 2):
        pictures.add(
            KeyframeDepth(frame, refined, np.ones_like(refined), image, np.eye(4), learned)
        )
    found = pictures.pictures()
    assert [picture.title for picture in found] == [
        f"Frame {frame}" for frame in (10, 20, 30, 40, 50)
    ]
    strip = pixels(found[0]).astype(int)
    assert strip.shape == (160, 3 * 480, 3)
    near, far, unknown = (strip[80, 960 + column] for column in (80, 240, 400))
    assert near.mean() > far.mean() + 80
    assert unknown.mean() < 20


@pytest.fixture
def report(make_run: MakeRun, view: MapView) -> Path:
    folder = make_run()
    write_report(folder, view=view)
    return folder.path / "report.html"


def browse(page: Path, *options: str) -> tuple[str, list[str]]:
    """Standard output of the browser, and the lines of its console."""
    profile = f"--user-data-dir={page.parent / 'profile'}"
    command = [CHROMIUM, *FLAGS.split(), NO_HOSTS, profile, *options, page.as_uri()]
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
def test_every_plot_is_drawn_and_nothing_offers_to_send_it(report: Path):
    page, console = browse(report, "--dump-dom")
    assert console == []
    assert page.count('class="plot"') == page.count('class="modebar-container"') == 5
    titles = set(re.findall('data-title="([^"]*)"', page))
    of_map = {"Orbital rotation", "Reset camera to default"}
    assert titles == {"Zoom", "Pan", "Reset axes", "Download plot as a PNG"} | of_map


@browser
def test_the_map_turns_with_the_mouse(report: Path):
    page, console = browse(changed(report, "turned.html", DRAG), "--dump-dom")
    assert console == [] and "<title>turned</title>" in page


@browser
def test_a_request_of_the_page_would_be_refused_and_said(report: Path):
    picture = '<img alt="" src="http://127.0.0.1:9/picture.png">'
    _, console = browse(changed(report, "asking.html", picture), "--dump-dom")
    assert len(console) == 1 and "Content Security Policy" in console[0]


def test_what_is_fixed_to_the_camera_is_red():
    fixed = np.zeros((30, 40), bool)
    assert not fixed_pictures(np.full((120, 160, 3), 90, np.uint8), fixed)
    fixed[20:] = True
    (picture,) = fixed_pictures(np.full((120, 160, 3), 90, np.uint8), fixed)
    image = pixels(picture)[..., ::-1]
    assert picture.title == "33 % of the image" and np.ptp(image[10].astype(int)) < 10
    assert image[-10, :, 0].min() > image[-10, :, 1].max() + 50
