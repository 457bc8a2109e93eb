"""The report is one valid, complete and self-contained page."""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread

from slam.results.folder import RunFolder
from slam.results.map_view import MapViews
from slam.results.report import DepthExample, write_report
from slam.trajectory import Trajectory

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


def test_its_table_marks_the_best_and_explains_what_is_missing(full: RunFolder) -> None:
    html, balance = parsed(full)
    assert '<td class="best">0.870</td>' in html
    assert "0.0123 ± 0.0060" in html
    missing = [attrs for tag, attrs in balance.tags if tag == "td" and attrs.get("class") == "missing"]
    assert missing
    assert all(attrs.get("title") for attrs in missing)
    assert "t_rel, % (7 dof) of odometry: no segment of 100 m was left" in html
    assert "lidar trajectory: the sequence has no LiDAR scans" in html


def test_the_error_of_the_map_has_its_truth_and_a_curve(full: RunFolder) -> None:
    html, balance = parsed(full)
    words = " ".join(balance.words)
    for said in ("where the scanner looked", "with one scale", "10 to 15 m", "LiDAR scans accumulated at true poses"):
        assert said in words
    assert "0.081" in words and "0.729" in words and "the true surface is not known" in html


def test_without_a_truth_the_reason_is_given(make_run: MakeRun, make_metrics: MakeMetrics) -> None:
    metrics = make_metrics()
    metrics["map"] = {"triangles": 5, "points": 7, "blocks": 1, "truth": None, "truth_reason": "no true poses"}
    folder = make_run(metrics=metrics)
    write_report(folder, examples(), None)
    html, _ = parsed(folder)
    assert "error of the map: no true poses" in html and "Map error over distance" not in html


def test_loops_are_listed_with_their_verdict(full: RunFolder) -> None:
    _, balance = parsed(full)
    words = " ".join(balance.words)
    assert "12 candidates, 3 verified, 1 accepted" in words
    assert words.index("295") < words.index("parallax <b>too small</b>")


def test_without_the_viewer_the_pictures_stay_and_no_script(make_run: MakeRun, map_views: MapViews) -> None:
    folder = make_run()
    write_report(folder, [], replace(map_views, viewer=None))
    html, balance = parsed(folder)
    assert "<script" not in html
    assert "Map from the driver's seat" in [attrs["alt"] for tag, attrs in balance.tags if tag == "img"]


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


def test_loops_and_time_add_up(make_run: MakeRun, make_metrics: MakeMetrics) -> None:
    metrics = make_metrics()
    metrics["loops"]["rejected"] = [{"from": k, "to": 300, "reason": "few inliers"} for k in range(200)]
    metrics["timing"] |= {"seconds_total": 64.0, "stages": {"geometry": 40.0, "journal": 7.0}}
    folder = make_run(metrics=metrics)
    folder.write_text("loops.json", '{"accepted": [], "rejected": [], "rejected_left_out": 39}')
    write_report(folder, [], None)
    words = " ".join(parsed(folder)[1].words)
    assert "160 more in loops.json, without 39 rejected ones of fewest inliers." in words
    assert "everything else 17.0 s" in words and "journal, from which run --continue goes on 7.0 s" in words


def test_trajectories_without_common_stamps_leave_the_rest_of_the_report(make_run: MakeRun) -> None:
    folder = make_run()
    late = folder.trajectory("odometry")
    assert late is not None
    folder.write_trajectory("trajectory_lidar", Trajectory(late.stamps + 1e6, late.T_world_camera))
    write_report(folder, examples(), None)
    html, _ = parsed(folder)
    assert "not drawn, no time stamps match" in html
    assert html.count("<img") == 2  # depth and the error of the map
