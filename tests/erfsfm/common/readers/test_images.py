"""Image files: complete or refused, in natural order, of a known range of values."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from erfsfm.common.errors import DataError
from erfsfm.common.readers.images import (
    has_images,
    list_images,
    read_image,
    read_values,
    resize_image,
    stretch_of,
)


def test_reads_rgb_not_bgr(tmp_path: Path):
    image = np.zeros((4, 6, 3), np.uint8)
    image[..., 2] = 200  # red in OpenCV's order
    cv2.imwrite(str(tmp_path / "a.png"), image)
    read = read_image(tmp_path / "a.png")
    assert read.shape == (4, 6, 3) and read.dtype == np.uint8 and read.flags.c_contiguous
    assert read[0, 0].tolist() == [200, 0, 0]
    assert read_image(tmp_path / "a.png").shape == (4, 6, 3)


@pytest.mark.parametrize("dtype, value", [(np.uint8, 77), (np.uint16, 77 * 256)])
def test_grey_and_16_bit_images_become_three_channels(tmp_path: Path, dtype: type, value: int):
    cv2.imwrite(str(tmp_path / "a.png"), np.full((4, 6), value, dtype))
    assert (read_image(tmp_path / "a.png") == 77).all()
    assert read_image(tmp_path / "a.png").shape == (4, 6, 3)


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_a_part_of_sixteen_bits_is_stretched(tmp_path: Path, channels: int):
    path = tmp_path / "a.png"
    grey = np.random.default_rng(0).integers(0, 256, (240, 320, channels))
    values = (7000 + grey * (2000 / 255)).astype(np.uint16)
    values[..., 3:] = 65535  # opaque
    cv2.imwrite(str(path), values)
    read = read_image(path)
    assert np.abs(read[..., ::-1][..., : min(channels, 3)] - grey[..., :3]).max() <= 2
    values[..., :3] = 0
    cv2.imwrite(str(path), values)
    assert read_image(path).max() == 0, "a black image is accepted"


def test_one_stretch_serves_a_whole_recording(tmp_path: Path):
    """Half of the images are darker, and stay so."""
    grey = np.random.default_rng(0).integers(0, 256, (24, 32))
    paths = [tmp_path / f"{k}.png" for k in range(8)]
    for k, path in enumerate(paths):
        cv2.imwrite(str(path), (64 * grey * (0.25 if k > 3 else 1)).astype(np.uint16))
    stretch = stretch_of(paths, read_values)
    light, dark = (read_image(path, stretch)[..., 0].astype(float) for path in (paths[0], paths[7]))
    np.testing.assert_allclose(light, grey, atol=1.5)
    np.testing.assert_allclose(dark, grey / 4, atol=1.5)
    cv2.imwrite(str(paths[0]), grey.astype(np.uint8))
    assert stretch_of(paths, read_values) is None


def test_a_flipped_bit_of_a_png_is_one_line_and_no_words_of_libpng(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
):
    path = tmp_path / "0.png"
    cv2.imwrite(str(path), np.random.default_rng(0).integers(0, 255, (40, 60, 3), np.uint8))
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 4
    path.write_bytes(data)
    with pytest.raises(DataError, match=r"0\.png is truncated or damaged"):
        read_image(path)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize("keep", [0.0, 0.97])
def test_truncated_image_is_named(tmp_path: Path, suffix: str, keep: float):
    path = tmp_path / f"000000{suffix}"
    cv2.imwrite(str(path), np.random.default_rng(0).integers(0, 255, (60, 80, 3), dtype=np.uint8))
    path.write_bytes(path.read_bytes()[: int(keep * path.stat().st_size)])
    for read in (read_image, read_values):
        with pytest.raises(DataError, match=rf"000000{suffix} is (empty|truncated)"):
            read(path)


def test_a_video_behind_a_photo_is_left_out(tmp_path: Path):
    """As phones write motion photos; its bytes may look like markers."""
    path = tmp_path / "a.jpg"
    cv2.imwrite(str(path), np.full((60, 80, 3), 90, np.uint8))
    photo, clip = path.read_bytes(), b"....ftypmp42\xff\xd9..\xff\xda.."
    path.write_bytes(photo + clip)
    assert abs(int(read_image(path)[30, 40, 0]) - 90) <= 1
    path.write_bytes(photo[:-20] + clip.replace(b"\xff\xd9", b""))
    with pytest.raises(DataError, match="truncated"):
        read_image(path)


@pytest.mark.parametrize("side", [9_000, 32_000])
def test_more_pixels_than_can_be_are_not_taken_from_memory(tmp_path: Path, side: int):
    """The header announces them."""
    _, content = cv2.imencode(".png", np.zeros((8, 8), np.uint8))
    header = b"IHDR" + struct.pack(">II", side, side) + content.tobytes()[24:29]
    (tmp_path / "a.png").write_bytes(
        content.tobytes()[:12]
        + header
        + struct.pack(">I", zlib.crc32(header))
        + content.tobytes()[33:]
    )
    with pytest.raises(DataError, match=r"a\.png has more pixels than any camera"):
        read_image(tmp_path / "a.png")
    _, content = cv2.imencode(".jpg", np.zeros((8, 8), np.uint8))
    size = content.tobytes().index(b"\xff\xc0") + 5
    bomb = content.tobytes()[:size] + struct.pack(">HH", side, side) + content.tobytes()[size + 4 :]
    (tmp_path / "b.jpg").write_bytes(bomb)
    with pytest.raises(DataError, match=r"b\.jpg has more pixels than any camera"):
        read_image(tmp_path / "b.jpg")


def test_natural_order_ignores_other_files(tmp_path: Path):
    for name in ("img10.png", "img2.png", "img1.PNG", ".hidden.png", "ins.txt"):
        (tmp_path / name).write_bytes(b"")
    assert [p.name for p in list_images(tmp_path)] == ["img1.PNG", "img2.png", "img10.png"]
    assert list_images(tmp_path / "nowhere") == []
    assert has_images(tmp_path) and not has_images(tmp_path / "nowhere")


def test_resize_down_averages():
    image = np.zeros((8, 8, 3), np.uint8)
    image[::2] = 100
    assert (resize_image(image, 4, 4) == 50).all()
