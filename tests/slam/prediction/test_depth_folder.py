"""Depth from folders: which file belongs to which frame, unknown pixels, and folders that are refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from slam.config.sections import DepthConfig
from slam.frames import Frame
from slam.prediction.depth_source import DepthFolder, FrameNumbers
from slam.runtime.errors import SlamError

HEIGHT, WIDTH = 12, 40


def frame(index: int) -> Frame:
    return Frame(index, 0.1 * index, np.zeros((HEIGHT, WIDTH, 3), np.uint8))


def folder_of(path: Path, names: list[str]) -> Path:
    """Frame k is k + 1 metres away."""
    path.mkdir(exist_ok=True)
    for k, name in enumerate(names):
        np.save(path / name, np.full((HEIGHT, WIDTH), k + 1.0, np.float32))
    return path


def opened(folder: Path, numbers: FrameNumbers, kind: str = "npy", **settings: Any) -> DepthFolder:
    return DepthFolder(DepthConfig(source=f"{kind}:{folder}", **settings), numbers, WIDTH, HEIGHT)


def metres(source: DepthFolder, index: int) -> float:
    disparity = source.disparity(frame(index))
    assert disparity is not None
    return float(1 / disparity[0, 0])


@pytest.mark.parametrize("first", [0, 1, 100])
def test_files_belong_to_frames_in_the_order_of_their_numbers(tmp_path: Path, first: int) -> None:
    folder = folder_of(tmp_path, [f"depth_{first + k}.npy" for k in range(12)])  # 9 before 10
    source = opened(folder, FrameNumbers(12, 0, 12))
    assert [metres(source, k) for k in range(12)] == pytest.approx(range(1, 13))


def test_a_range_of_frames_takes_its_own_files_of_the_whole_sequence(tmp_path: Path) -> None:
    folder = folder_of(tmp_path, [f"{k:06d}.npy" for k in range(10)])
    assert metres(opened(folder, FrameNumbers(4, 5, 10)), 0) == pytest.approx(6)
    assert metres(opened(folder, FrameNumbers(10, 300, 400)), 0) == pytest.approx(1), "a folder of this range alone"


def test_a_missing_number_is_an_error_only_if_its_frame_is_there(tmp_path: Path) -> None:
    names = [f"{k:06d}.npy" for k in range(8)]
    folder = folder_of(tmp_path, names)
    (folder / names[3]).unlink()
    source = opened(folder, FrameNumbers(8, 0, 8))
    assert metres(source, 4) == pytest.approx(5)
    with pytest.raises(SlamError, match="no depth for frame 3"):
        source.disparity(frame(3))


@pytest.mark.parametrize(("scale", "value"), [(256.0, 10.0), (1000.0, 2.56)])
def test_pictures_of_16_bits_have_a_scale_and_zero_is_unknown(tmp_path: Path, scale: float, value: float) -> None:
    picture = np.full((HEIGHT, WIDTH), 2560, np.uint16)
    picture[0, 0] = 0
    cv2.imwrite(str(tmp_path / "000000.png"), picture)
    disparity = opened(tmp_path, FrameNumbers(1, 0, 1), "png", png_scale=scale).disparity(frame(0))
    assert disparity is not None and np.isnan(disparity[0, 0]) and disparity[5, 5] == pytest.approx(1 / value)


def test_disparity_may_be_given_and_axes_of_length_one_do_not_matter(tmp_path: Path) -> None:
    np.save(tmp_path / "0.npy", np.full((1, HEIGHT, WIDTH, 1), 0.125, np.float16))
    source = DepthFolder(DepthConfig(source=f"npy:{tmp_path}", kind="disparity"), FrameNumbers(1, 0, 1), WIDTH, HEIGHT)
    disparity = source.disparity(frame(0))
    assert disparity is not None and disparity.shape == (HEIGHT, WIDTH) and (disparity == 0.125).all()


def test_the_digest_is_of_names_and_content(tmp_path: Path) -> None:
    numbers = FrameNumbers(3, 0, 3)
    first = opened(folder_of(tmp_path / "a", ["0.npy", "1.npy", "2.npy"]), numbers).sha256
    copy = folder_of(tmp_path / "b", ["0.npy", "1.npy", "2.npy"])
    assert opened(copy, numbers).sha256 == first
    np.save(copy / "1.npy", np.full((HEIGHT, WIDTH), 2.5, np.float32))
    assert opened(copy, numbers).sha256 != first
