"""The report is one valid, complete and self-contained page."""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Callable
from html.parser import HTMLParser
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread

from slam.formats.trajectory import Trajectory
from slam.results.folder import RunFolder
from slam.results.report.map_view import MapViews
from slam.results.report.page import DepthExample, write_report

MakeRun = Callable[..., RunFolder]
MakeMetrics = Callable[..., dict[str, Any]]

VOID = {"meta", "img", "br", "hr", "link", "input"}


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


def examples() -> list[DepthExample]:
    image = np.full((32, 104, 3), 90, dtype=np.uint8)
    depth = np.linspace(1.0, 40.0, 32 * 104, dtype=np.float32).reshape(32, 104)
    return [DepthExample(index, image, depth) for index in (10, 20)]


@pytest.fixture
def full(make_run: MakeRun, map_views: MapViews) -> RunFolder:
    folder = make_run()
    write_report(folder, examples(), map_views)
    return folder


def test_a_full_report_is_balanced_and_needs_no_network(full: RunFolder) -> None:
    html, balance = parsed(full)
    without_data = re.sub(r"[\w+/=]{200,}", "", html)
    assert not re.search(r'https?:|@import|url\(|src="(?!data:)|<link', without_data)
    (policy,) = [attrs["content"] for _, attrs in balance.tags if attrs.get("http-equiv") == "Content-Security-Policy"]
    assert str(policy).startswith("default-src 'none'")
    addresses = [attrs["href"] for tag, attrs in balance.tags if tag == "a"]
    assert addresses
    assert all((full.path / str(address)).is_file() for address in addresses)
    assert not list(full.path.glob(".*"))


def test_its_pictures_are_whole_and_not_blank(full: RunFolder) -> None:
    _, balance = parsed(full)
    pictures = [attrs for tag, attrs in balance.tags if tag == "img"]
    assert [each["alt"] for each in pictures] == [
        "Trajectories from above",
        "Position error over distance travelled",
        "Drift over segment length",
        "Depth maps",
        "Map from above",
        "Map from the driver's seat",
        "Map error over distance",
    ]
    for each in pictures:
        data = str(each["src"]).removeprefix("data:image/png;base64,")
        assert imread(io.BytesIO(base64.b64decode(data)))[..., :3].std() > 0.02


def test_it_shows_the_inputs_of_the_run_escaped(full: RunFolder) -> None:
    html, balance = parsed(full)
    words = " ".join(balance.words)
    for said in ("sim/loop <42>", "MIT: trained on our own", "erfsfm-slam run --sequence '<b>09</b>' & more"):
        assert said in words
    assert "mode camera-height, value 1.6503" in words
    assert "<b>09" not in html
    assert "<b>too small" not in html
    assert "LEAK" not in html


def test_a_leak_is_stamped(make_run: MakeRun, make_metrics: MakeMetrics) -> None:
    folder = make_run(metrics=make_metrics(leak=True))
    write_report(folder, [], None)
    html, _ = parsed(folder)
    assert '<div class="stamp" role="alert"><b>LEAK</b>' in html


def test_without_reference_and_map_the_report_has_the_reasons(make_run: MakeRun, make_metrics: MakeMetrics) -> None:
    metrics = make_metrics(reference=False, mode="none")
    metrics |= {"map": None, "map_reason": "fusion is switched off"}
    metrics["loops"] = {"candidates": None, "candidates_reason": "this part is not built yet", "rejected": []}
    folder = make_run(metrics=metrics, reference=False)
    write_report(folder, [], None)
    html, balance = parsed(folder)
    words = " ".join(balance.words)
    assert "No errors: the sequence has no true poses" in words
    assert "No map: fusion is switched off" in words
    assert "this part is not built yet" in words
    assert "camera heights" in words
    assert html.count("<img") == 1
    assert "Position error" not in words and "Every alignment" not in words, "no numbers that are dashes alone"


def test_a_failed_run_has_its_reason(make_run: MakeRun) -> None:
    metrics = {"schema": 1, "status": "failed", "reason": "frame 7 <is> broken", "provenance": None}
    folder = make_run(metrics=metrics, reference=False)
    for path in folder.path.glob("trajectory_*"):
        path.unlink()
    write_report(folder, [], None)
    html, balance = parsed(folder)
    assert "frame 7 <is> broken" in balance.words
    assert "No trajectory was written" in html
    assert "FAILED" in html


def test_a_damaged_loops_file_leaves_the_rest_of_the_report(make_run: MakeRun) -> None:
    folder = make_run()
    folder.write_text("loops.json", "{")
    write_report(folder, [], None)
    assert "12 candidates" in parsed(folder)[0]


def test_trajectories_without_common_stamps_leave_the_rest_of_the_report(make_run: MakeRun) -> None:
    folder = make_run()
    late = folder.trajectory("odometry")
    assert late is not None
    folder.write_trajectory("lidar", Trajectory(late.stamps + 1e6, late.T_world_camera))
    write_report(folder, examples(), None)
    html, _ = parsed(folder)
    assert "not drawn, no time stamps match" in html
    assert html.count("<img") == 2  # depth and the error of the map
