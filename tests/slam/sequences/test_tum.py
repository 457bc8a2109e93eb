from pathlib import Path

import cv2
import numpy as np
import pytest

from erfsfm.common.errors import DataError
from slam.runtime.errors import SequenceError
from slam.sequences.catalogue import open_sequence

STAMPS = [100.02, 100.05, 100.09]


@pytest.fixture
def folder(tmp_path: Path, images, camera_yaml: str) -> Path:
    root = tmp_path / "freiburg"
    images(root / "rgb", [f"{stamp}.png" for stamp in STAMPS])
    rows = "".join(f"{stamp} rgb/{stamp}.png\n" for stamp in STAMPS)
    (root / "rgb.txt").write_text("# colour images\n# timestamp filename\n" + rows)
    (root / "camera.yaml").write_text(camera_yaml)
    return root


def write_truth(folder: Path, stamps: np.ndarray) -> None:
    """Straight ahead at 1 m/s, turning about y by 0.5 rad/s."""
    half = 0.25 * (stamps - 100)
    rows = [f"{s:.4f} 0 0 {s - 100:.6f} 0 {np.sin(h):.9f} 0 {np.cos(h):.9f}\n" for s, h in zip(stamps, half)]
    (folder / "groundtruth.txt").write_text("# timestamp tx ty tz qx qy qz qw\n" + "".join(rows))


def test_opens(folder: Path) -> None:
    sequence = open_sequence(folder, None, None, None)
    assert (sequence.name, len(sequence), sequence.reference) == ("freiburg", 3, None)
    assert sequence.stamps.tolist() == STAMPS
    assert sequence.frame(2).image[0, 0, 0] == 20
    assert sequence.provenance() == ("tum/freiburg[0:3]",)
    assert sequence.camera_height_m is None and not sequence.has_scan(0)


def test_truth_is_interpolated(folder: Path) -> None:
    write_truth(folder, np.arange(100.0, 100.2, 0.02))
    reference = open_sequence(folder, None, None, None).reference
    assert reference is not None
    assert np.array_equal(reference[0], np.eye(4))
    # 0.03 s after the first image, seen from a camera turned by 0.01 rad
    assert reference[1, :3, 3] == pytest.approx([-0.03 * np.sin(0.01), 0, 0.03 * np.cos(0.01)], abs=1e-6)
    assert reference[1, 0, 2] == pytest.approx(np.sin(0.015), abs=1e-6)


@pytest.mark.parametrize(
    "text, message",
    [
        ("# nothing\n", "there is no row"),
        ("100.0 rgb/100.02.png extra\n", "line 1: .*is not 'stamp file'"),
        ("soon rgb/100.02.png\n", "line 1: .*is not 'stamp file'"),
        ("100.0 rgb/gone.png\n", "none of the 1 images"),
    ],
)
def test_malformed_index(folder: Path, text: str, message: str) -> None:
    (folder / "rgb.txt").write_text(text)
    with pytest.raises((SequenceError, DataError), match=message):
        open_sequence(folder, None, None, None)


def test_bad_rows_are_left_out(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    known = open_sequence(folder)
    index = folder / "rgb.txt"
    rows = index.read_text().splitlines()
    index.write_text("\n".join([*rows, rows[-1], "soon rgb/100.02.png"]))
    again = open_sequence(folder)
    np.testing.assert_array_equal(again.stamps, known.stamps)
    assert len(again) == len(known) and "2 of " in caplog.text


@pytest.mark.parametrize("rows", [("100.035 near.png", "100.30 far.png"), ("100.30 far.png", "100.035 near.png")])
def test_registered_depth_maps_belong_to_the_images_of_their_stamps(folder: Path, rows: tuple[str, str]) -> None:
    sequence = open_sequence(folder)
    assert sequence.true_depth_frames() == []
    cv2.imwrite(str(folder / "near.png"), np.full((4, 6), 10_000, dtype=np.uint16))
    cv2.imwrite(str(folder / "far.png"), np.full((4, 6), 20_000, dtype=np.uint16))
    (folder / "depth.txt").write_text("\n".join(["# timestamp filename", *rows]))
    sequence = open_sequence(folder)
    assert sequence.true_depth_frames() == [0, 1]
    np.testing.assert_array_equal(sequence.true_depth(1), np.full((4, 6), 2.0))
