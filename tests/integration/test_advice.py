"""Advice in messages is followed: what it is about works then, without a message."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from slam.commands.evaluation import compare
from slam.formats.trajectory import read_trajectory
from slam.runtime.errors import SlamError
from slam.sequences.camera_file import explicit_camera
from slam.sequences.catalogue import open_sequence
from slam.sequences.stream import FolderSource, StreamedSequence

# what was tried, the advice in its message, and what is tried when one follows it
Case = tuple[Callable[[], Any], str, Callable[[re.Match[str]], Any]]


def decimal_commas(folder: Path) -> Case:
    path = folder / "poses.txt"
    path.write_text("0,1 0 0 0 0 0 0 1\n0,2 1,5 0 0 0 0 0 1\n")

    def follow(_: re.Match[str]) -> None:
        path.write_text(path.read_text().replace(",", "."))
        assert read_trajectory(path).positions[1, 0] == 1.5

    return lambda: read_trajectory(path), "decimals are written with a point", follow


def rows_of_other_frames(folder: Path) -> Case:
    rows = [f"1 0 0 {k * k} 0 1 0 0 0 0 1 {k}\n" for k in range(20)]
    estimate, truth = folder / "estimate.txt", folder / "truth.txt"
    truth.write_text("".join(rows))
    estimate.write_text("".join(rows[5:15]))

    def follow(_: re.Match[str]) -> None:
        (run,) = compare([("ours", estimate)], truth, frames="5:15")
        assert run.errors.align.none.ate_rmse_m == 0

    return (
        lambda: compare([("ours", estimate)], truth),
        r"give .* with --frames A:B and --reference",
        follow,
    )


def rate_of_another_video(folder: Path) -> Case:
    video, camera = folder / "drive.avi", folder / "camera.yaml"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*"MJPG"), 10, (40, 24))
    for k in range(5):
        writer.write(np.full((24, 40, 3), k, np.uint8))
    writer.release()
    camera.write_text("width: 40\nheight: 24\nfx: 30\nfy: 30\ncx: 20\ncy: 12\nfps: 25\n")

    def follow(advice: re.Match[str]) -> None:
        camera.write_text(camera.read_text().replace("fps: 25", f"fps: {advice[1]}"))
        np.testing.assert_allclose(open_sequence(video).stamps, 0.1 * np.arange(5))

    return (
        lambda: open_sequence(video),
        r"has (\S+) frames a second, .*: taken as even .*; correct fps",
        follow,
    )


def every_frame_of_a_camera(folder: Path) -> Case:
    cv2.imwrite(str(folder / "0.png"), np.zeros((24, 40, 3), np.uint8))
    source = FolderSource(folder, 1.0)
    source.is_stored = False
    camera = explicit_camera(Path("fov=70"), source)

    def follow(_: re.Match[str]) -> None:
        assert len(list(StreamedSequence("door", source, camera, 0.2).frames())) == 1

    return (
        lambda: StreamedSequence("door", source, camera, 0.2, every_frame=True),
        "leave out --every-frame",
        follow,
    )


@pytest.mark.parametrize(
    "case", [decimal_commas, rows_of_other_frames, rate_of_another_video, every_frame_of_a_camera]
)
def test_advice_that_is_followed_helps(
    case: Callable[[Path], Case], tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    attempt, words, follow = case(tmp_path)
    try:
        attempt()
        said = caplog.text
    except SlamError as error:
        said = str(error)
    advice = re.search(words, said)
    assert advice, said
    caplog.clear()
    follow(advice)
    assert caplog.text == ""
