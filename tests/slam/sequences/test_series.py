"""Pieces of one recording are one drive; other recordings beside them are not."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from slam.sequences.catalogue import open_sequence, sequence_kinds


def write_clip(path: Path, first: int, count: int = 20) -> None:
    """Frames at 10 a second, each as bright as its number."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10, (40, 24))
    for k in range(first, first + count):
        writer.write(np.full((24, 40, 3), k, np.uint8))
    writer.release()


@pytest.fixture
def trip(tmp_path: Path, camera_yaml: str) -> Path:
    (tmp_path / "camera.yaml").write_text(camera_yaml.replace("fps: 5", "fps: 10"))
    return tmp_path


def shown(sequence) -> list[int]:
    return [round(float(sequence.frame(k).image.mean())) for k in range(len(sequence))]


def test_chapters_of_a_camera(trip: Path) -> None:
    for k, name in enumerate(("GX010042", "GX020042", "GX030042")):
        write_clip(trip / f"{name}.avi", 20 * k)
    write_clip(trip / "GX010043.avi", 200)
    assert sorted(sequence_kinds(trip)) == ["GX010042", "GX010043"]
    sequence = open_sequence(trip, "GX010042")
    np.testing.assert_allclose(shown(sequence), range(60), atol=2)
    np.testing.assert_allclose(sequence.stamps, 0.1 * np.arange(60), atol=1e-6)
    assert len(open_sequence(trip / "GX020042.avi")) == 20
    assert sequence.provenance()[1].endswith("GX020042[0:20]")
    (trip / "GX020042.avi").unlink()
    gap = np.diff(open_sequence(trip, "GX010042").stamps)
    np.testing.assert_allclose(gap[[18, 19, 20]], [0.1, 2.1, 0.1], atol=1e-6)


def test_files_named_by_their_time(trip: Path) -> None:
    for k, second in enumerate((0, 2, 4, 8, 59)):
        write_clip(trip / f"20240101_1200{second:02d}_F.avi", 20 * k)
    assert sorted(sequence_kinds(trip)) == ["20240101_120000_F", "20240101_120059_F"]
    sequence = open_sequence(trip, "20240101_120000_F")
    assert len(sequence) == 80
    np.testing.assert_allclose(np.diff(sequence.stamps)[[19, 39, 59]], [0.1, 0.1, 2.1], atol=1e-6)


def test_clips_named_by_the_minute_that_are_shorter(trip: Path, caplog: pytest.LogCaptureFixture) -> None:
    for k, minute in enumerate((0, 1, 2, 4)):
        write_clip(trip / f"20240101_12{minute:02d}00_F.avi", 20 * k)
    gaps = np.diff(open_sequence(trip).stamps)
    np.testing.assert_allclose(gaps[[19, 39, 59]], [0.1, 0.1, 2.1], atol=1e-6)
    assert "named 60 s apart: taken as following each other" in caplog.text


def test_numbered_folders(trip: Path, images) -> None:
    for name in ("000", "001"):
        images(trip / name, [f"{k}.png" for k in range(5)])
    sequence = open_sequence(trip)
    assert len(sequence) == 10 and (np.diff(sequence.stamps) > 0).all()


@pytest.mark.parametrize(
    "names",
    [
        ("GOPR0042", "GP010042", "GP020042"),
        ("2024_0101_120000_0001F", "2024_0101_120002_0002F", "2024_0101_120004_0003F"),
        ("NO20240101-120000-000001F", "NO20240101-120002-000002F", "NO20240101-120004-000003F"),
        ("walk_part1", "walk_part2", "walk_part3"),
    ],
)
def test_namings_of_pieces(trip: Path, names: tuple[str, ...]) -> None:
    for k, name in enumerate(names):
        write_clip(trip / f"{name}.avi", 20 * k)
    np.testing.assert_allclose(open_sequence(trip).stamps, 0.1 * np.arange(60), atol=1e-6)
