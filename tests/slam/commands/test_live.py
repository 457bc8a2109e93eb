"""Live runs: a folder being filled, broken images, drives that fail, signals."""

from __future__ import annotations

import json
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from threading import Thread
from typing import Any

import cv2
import numpy as np
import pytest

from slam import run_slam
from slam.commands.live import LiveRequest, run_live
from slam.runtime.errors import SlamError

SETTINGS = ("mapping.enabled=false", "output.report=false")
FRAMES = 14


@pytest.fixture(scope="module")
def street(kitti_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Images of a simulated street and their ``camera.yaml``."""
    folder = tmp_path_factory.mktemp("street")
    images = sorted((kitti_root / "sequences" / "sim" / "image_2").glob("*.png"))[:FRAMES]
    (folder / "images").mkdir()
    for path in images:
        shutil.copy(path, folder / "images" / path.name)
    camera = (kitti_root / "camera.yaml").read_text()
    no_lens = "model: opencv\ndistortion: [0, 0, 0, 0]"
    (folder / "camera.yaml").write_text(camera.replace("model: pinhole\ndistortion: []", no_lens))
    return folder


def request_of(
    source: Path | str, weights: Path, settings: Sequence[str], output: Path, **options: Any
) -> LiveRequest:
    return LiveRequest(
        dataset=str(source),
        output=output,
        weights=str(weights),
        overrides=list(settings),
        **options,
    )


def filled(
    street: Path,
    tmp_path: Path,
    frames: int = FRAMES,
    broken: dict[int, bytes] | None = None,
    vanishes: bool = True,
) -> tuple[Path, list[dict[str, Any]]]:
    """A folder beside its camera file, and the list of messages that it is filled by.

    An image comes each time the one before was answered, ``broken`` ones at once; after the last, the folder vanishes.
    """
    target, messages, broken = tmp_path / "images", [], broken or {}
    target.mkdir()
    shutil.copy(street / "camera.yaml", tmp_path)
    contents = (
        dict(
            enumerate(path.read_bytes() for path in sorted((street / "images").iterdir())[:frames])
        )
        | broken
    )

    def run() -> None:
        answered = 0
        for number, content in contents.items():
            (target / ".partial").write_bytes(content)
            (target / ".partial").rename(target / f"{number:06d}.png")
            answered += number not in broken
            while len(messages) < answered:
                time.sleep(0.01)
        if vanishes:
            target.rename(target.with_name("unplugged"))

    Thread(target=run, daemon=True).start()
    return target, messages


def test_a_folder_being_filled_gives_the_bytes_of_a_run(
    street: Path, tiny_weights: Path, tmp_path: Path
):
    target, messages = filled(street, tmp_path)
    request = request_of(target, tiny_weights, SETTINGS, tmp_path / "live", wait=600)
    folder = run_live(request, messages.append)
    offline = run_slam(street, weights=tiny_weights, overrides=SETTINGS, output=tmp_path / "run")
    for name in (
        "trajectory_optimised.kitti.txt",
        "trajectory_odometry.tum.txt",
        "graph.g2o",
        "loops.json",
    ):
        assert (folder.path / name).read_bytes() == (offline.path / name).read_bytes()
    *poses, last = messages
    assert [message["frame"] for message in poses] == list(range(FRAMES))
    assert all(message["dropped"] == 0 and message["latency_ms"] > 0 for message in poses)
    # how soon this little network knows its scale depends on the machine that trained it
    has_scale = [message["unit"] == "m" for message in poses]
    assert [message["state"] == "tracking" for message in poses] == has_scale == sorted(has_scale)
    assert all(message["state"] == "starting" or message["scale"] > 0 for message in poses)
    corrected = np.array(last["T_world_camera"])
    np.testing.assert_allclose(
        corrected, np.loadtxt(folder.path / "trajectory_optimised.kitti.txt"), atol=1e-6
    )
    assert last["dropped"] == 0
    assert folder.metrics().tree()["status"] == "ok"


@pytest.mark.parametrize(("mode", "unit"), [("auto", None), ("none", "the networks' own unit")])
def test_without_a_road_there_are_no_metres_and_no_camera_heights(
    street: Path,
    tiny_weights: Path,
    tmp_path: Path,
    mode: str,
    unit: str | None,
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.setattr("slam.frontend.ground_plane._ROAD_ROWS", (0.0, 0.001))  # at the horizon
    monkeypatch.setattr("slam.frontend.road._MIN_POINTS", 10**6)  # of the homography
    target, messages = filled(street, tmp_path)
    settings = (*SETTINGS, f"scale.mode={mode}")
    request = request_of(target, tiny_weights, settings, tmp_path / "live", wait=600)
    folder = run_live(request, messages.append)
    recorded = folder.metrics().tree()["scale"]
    assert (recorded["unit"], recorded["value"]) == ("the networks' own unit", None)
    *poses, last = messages
    assert last["unit"] == unit
    starting, known = ("starting", None, False), ("tracking", unit, True)
    said = [(each["state"], each["unit"], each["scale"] is not None) for each in poses]
    assert set(said) == ({starting} if unit is None else {starting, known})
    assert ["networks' own unit" in note for note in folder.metrics().unit_notes()] == [True]


def test_broken_images_are_left_out_and_a_folder_that_vanishes_leaves_a_whole_run(
    street: Path, tiny_weights: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    cut = sorted((street / "images").iterdir())[5].read_bytes()[:2000]
    small = cv2.imencode(".png", np.zeros((20, 30, 3), np.uint8))[1].tobytes()
    target, messages = filled(street, tmp_path, broken={5: cut, 8: small})
    request = request_of(target, tiny_weights, SETTINGS, tmp_path / "live", wait=600)
    folder = run_live(request, messages.append)
    *poses, last = messages
    used = [0.1 * number for number in range(FRAMES) if number not in (5, 8)]
    assert [message["stamp"] for message in poses] == pytest.approx(used) == last["stamps"]
    assert (
        last["ended"].startswith("the source died") and "cannot be read any more" in last["ended"]
    )
    assert folder.metrics().tree()["status"] == "ok" and folder.metrics().tree()["sequence"][
        "frames"
    ] == len(used)
    said = caplog.text
    assert (
        "000005.png" in said
        and "000008.png is 30 x 20, not" in said
        and said.count("it is left out") == 2
    )


def test_images_that_are_there_are_dropped_and_counted_unless_every_one_is_wanted(
    street: Path, tiny_weights: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    messages: list[dict[str, Any]] = []
    request = request_of(street / "images", tiny_weights, SETTINGS, tmp_path / "live", wait=0.5)
    try:  # while the first one is measured, most others come: how many frames are left depends on the machine
        run_live(request, messages.append)
        assert (
            messages[-1]["dropped"] > 0
            and len(messages[-1]["stamps"]) + messages[-1]["dropped"] == FRAMES
        )
    except SlamError as error:
        assert re.search(r"images were dropped, .* \(--every-frame drops none\)", str(error))
    assert re.search("images (were )?dropped", caplog.text)
    folder = run_live(request.model_copy(update={"every_frame": True}), messages.append)
    assert messages[-1]["dropped"] == 0 and folder.metrics().tree()["sequence"]["frames"] == FRAMES


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (
            ("scale.mode=camera-height",),
            "scale mode camera-height needs a known height; images has none",
        ),
        (("lidar.factors=true",), r"lidar\.factors=true needs LiDAR scans of neighbouring frames"),
    ],
)
def test_what_the_settings_need_is_asked_before_the_first_frame(
    street: Path, tiny_weights: Path, tmp_path: Path, settings: tuple[str, ...], words: str
):
    """A camera by its field of view alone has no height; frames that come have no scans and no numbers."""
    settings = (*SETTINGS, *settings)
    images, messages = str(street / "images"), []
    request = request_of(
        images, tiny_weights, settings, tmp_path / "live", camera=Path("fov=70"), wait=0.5
    )
    with pytest.raises(SlamError, match=words):
        run_live(request, messages.append)
    assert messages == [] and not (tmp_path / "live").exists()


def test_the_password_of_an_address_is_written_nowhere(
    street: Path, tiny_weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    address = "rtsp://me:hush@camera/drive?pwd=quiet&x=1"
    images, opened, capture = str(street / "images" / "%06d.png"), [], cv2.VideoCapture

    def open_street(name: str) -> cv2.VideoCapture:
        opened.append(name)
        return capture(images)

    monkeypatch.setattr(cv2, "VideoCapture", open_street)
    settings, command = [*SETTINGS, f"output.root={tmp_path}"], f"erfsfm-slam live {address}"
    request = LiveRequest(
        dataset=address,
        weights=str(tiny_weights),
        overrides=settings,
        camera=street / "camera.yaml",
        wait=0.5,
        command=command,
    )
    with suppress(SlamError):  # where too few images come before the last
        run_live(request, lambda message: None)
    assert set(opened) == {address}
    metrics = next(tmp_path.glob("*/metrics.json"))  # also by the link to the latest run
    assert "rtsp://...@camera/drive?pwd=...&x=1" in metrics.read_text()
    for path in tmp_path.rglob("*"):
        text = path.read_text(errors="replace") if path.is_file() else ""
        assert not re.search("hush|quiet", f"{path.name} {text}"), path
    with pytest.raises(SlamError, match=r"rtsp://\.\.\.@camera"):
        raise SlamError(f"no image comes from {address}")


@pytest.mark.parametrize("frames", [2, 9])
def test_a_drive_that_fails_leaves_the_poses_that_it_had(
    street: Path, tiny_weights: Path, tmp_path: Path, frames: int
):
    """After the last of two frames, which are too few, and at the ninth, which nobody listens to."""
    target, messages = filled(street, tmp_path, frames)

    def listen(message: dict[str, Any]) -> None:
        messages.append(message)
        if len(messages) == 9:
            raise SlamError("nobody listens")

    request = request_of(target, tiny_weights, SETTINGS, tmp_path / "live", wait=600)
    with pytest.raises(SlamError, match="nobody listens" if frames == 9 else "usable frames"):
        run_live(request, listen)
    metrics = json.loads((tmp_path / "live" / "metrics.json").read_text())
    assert metrics["status"] == "failed" and metrics["reason"]
    left = np.loadtxt(
        tmp_path / "live" / "trajectory_odometry.kitti.txt"
    )  # said poses were corrected since
    np.testing.assert_allclose(left[0], messages[0]["T_world_camera"])
    assert (np.linalg.norm(np.diff(left[:, 3::4], axis=0), axis=1) > 0).all() == (frames == 9)
    stamps = np.loadtxt(tmp_path / "live" / "trajectory_odometry.tum.txt")[:, 0]
    np.testing.assert_allclose(stamps, [message["stamp"] for message in messages])
    assert not (tmp_path / "live" / "trajectory_optimised.tum.txt").exists()


def test_the_viewer_is_shown_the_drive(
    street: Path, tiny_weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """What it would show goes to a file, as it does without a screen."""
    rerun = pytest.importorskip("rerun", reason="the extra rerun is not installed")
    shown = tmp_path / "shown.rrd"
    monkeypatch.setattr(rerun.RecordingStream, "spawn", lambda stream: stream.save(shown))
    target, messages = filled(street, tmp_path)
    settings, output = SETTINGS[1:], tmp_path / "run"  # keyframes are kept for the map
    request = request_of(target, tiny_weights, settings, output, wait=600, view=True)
    run_live(request, messages.append)
    content = shown.read_bytes()
    assert content[:3] == b"RRF"
    for place in (
        b"/world/path",
        b"/world/camera",
        b"/world/camera/image",
        b"/depth",
        b"/world/map/",
    ):
        assert place in content, place


@pytest.mark.parametrize(
    "number",
    [
        signal.SIGINT,
        *(pytest.param(n, marks=pytest.mark.slow) for n in (signal.SIGTERM, signal.SIGHUP)),
    ],
)
def test_a_signal_leaves_a_whole_run(
    street: Path, tiny_weights: Path, tmp_path: Path, number: signal.Signals
):
    output = tmp_path / "run"
    target, messages = filled(street, tmp_path, vanishes=False)
    command = [
        sys.executable,
        "-m",
        "slam",
        "live",
        "--dataset",
        str(target),
        "--output",
        str(output),
        "--wait",
        "600",
    ]
    command += ["--camera", str(street / "camera.yaml")]
    command += ["--weights", str(tiny_weights), *(word for s in SETTINGS for word in ("--set", s))]
    heeded = partial(
        signal.signal, number, signal.SIG_DFL
    )  # what a shell runs in the background ignores ctrl-C
    pipe = subprocess.PIPE
    with subprocess.Popen(
        command, stdout=pipe, stderr=pipe, text=True, preexec_fn=heeded
    ) as process:
        for _ in range(FRAMES):
            messages.append(json.loads(process.stdout.readline()))
        process.send_signal(number)
        rest, said = process.communicate()
    assert process.returncode == 0, said
    last = json.loads(rest.splitlines()[-1])
    assert last["type"] == "trajectory" and last["ended"] == "it was interrupted"
    assert len(last["stamps"]) == FRAMES == messages[-1]["frame"] + 1
    metrics = json.loads((output / "metrics.json").read_text())
    assert metrics["status"] == "ok"
    recording = {"dataset": str(target), "camera": str(street / "camera.yaml")}
    assert metrics["provenance"]["recording"] == recording
