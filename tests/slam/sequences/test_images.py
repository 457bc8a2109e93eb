from pathlib import Path

import cv2
import numpy as np
import pytest

from slam.errors import SequenceError
from slam.sequences.images import ImageFiles, list_images, read_image, require_no_gap, require_numbered


def test_reads_rgb_not_bgr(tmp_path: Path) -> None:
    image = np.zeros((4, 6, 3), np.uint8)
    image[..., 2] = 200  # red in OpenCV's order
    cv2.imwrite(str(tmp_path / "a.png"), image)
    read = read_image(tmp_path / "a.png")
    assert read.shape == (4, 6, 3) and read.dtype == np.uint8
    assert read[0, 0].tolist() == [200, 0, 0]


@pytest.mark.parametrize("dtype, value", [(np.uint8, 77), (np.uint16, 77 * 256)])
def test_grey_and_deep_images_become_three_channels(tmp_path: Path, dtype: type, value: int) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.full((4, 6), value, dtype))
    assert (read_image(tmp_path / "a.png") == 77).all()
    assert read_image(tmp_path / "a.png").shape == (4, 6, 3)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize("keep", [0.0, 0.5, 0.97])
def test_truncated_image_is_named(tmp_path: Path, suffix: str, keep: float) -> None:
    path = tmp_path / f"000000{suffix}"
    noise = np.random.default_rng(0).integers(0, 255, (60, 80, 3), dtype=np.uint8)
    cv2.imwrite(str(path), noise)
    data = path.read_bytes()
    path.write_bytes(data[: int(keep * len(data))])
    with pytest.raises(SequenceError, match=rf"000000{suffix} is (empty|truncated)"):
        read_image(path)


def test_not_an_image(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_text("hello")
    with pytest.raises(SequenceError, match=r"a\.png cannot be decoded"):
        read_image(tmp_path / "a.png")
    with pytest.raises(SequenceError, match=r"cannot read image .*b\.png"):
        read_image(tmp_path / "b.png")


def test_another_size_names_both(tmp_path: Path, images) -> None:
    images(tmp_path, ["0.png", "1.png"])
    images(tmp_path, ["2.png"], width=41)
    files = ImageFiles(list_images(tmp_path))
    assert (files.width, files.height, len(files)) == (40, 24, 3)
    assert files.read(1)[0, 0, 0] == 10
    with pytest.raises(SequenceError, match=r"2\.png is 41x24, but 0\.png is 40x24"):
        files.read(2)


def test_natural_order_ignores_other_files(tmp_path: Path, images) -> None:
    images(tmp_path, ["img10.png", "img2.png", "img1.PNG", ".hidden.png"])
    (tmp_path / "ins.txt").write_text("1 2 3")
    assert [p.name for p in list_images(tmp_path)] == ["img1.PNG", "img2.png", "img10.png"]
    assert list_images(tmp_path / "nowhere") == []


def test_two_formats_of_one_image(tmp_path: Path, images) -> None:
    images(tmp_path, ["0.png", "0.jpg"])
    with pytest.raises(SequenceError, match="image 0 in two formats"):
        list_images(tmp_path)


@pytest.mark.parametrize(
    "names, missing",
    [(["000000", "000001", "000003"], "000002.png"), (["000001", "000002"], "000000.png")],
)
def test_missing_number_is_named(names: list[str], missing: str) -> None:
    with pytest.raises(SequenceError, match=f"no image {missing}"):
        require_numbered([Path(f"{name}.png") for name in names])


def test_unnumbered_name() -> None:
    with pytest.raises(SequenceError, match="not named by its number"):
        require_numbered([Path("000000.png"), Path("extra.png")])


@pytest.mark.parametrize(
    "names",
    [
        ["a", "b", "d"],
        ["0", "5", "10", "15"],
        ["frame_07", "frame_08", "frame_09"],
        ["1305031102.175304", "1305031102.211214", "1305031102.243211"],
        ["only"],
    ],
)
def test_folder_names_without_gap(names: list[str]) -> None:
    require_no_gap([Path(f"{name}.png") for name in names])


def test_folder_gap_is_named() -> None:
    names = ["frame_07", "frame_08", "frame_09", "frame_11", "frame_12"]
    with pytest.raises(SequenceError, match=r"no image frame_10\.png"):
        require_no_gap([Path(f"{name}.png") for name in names])
