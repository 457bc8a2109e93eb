"""Which frames of a raw drive are left out because the car stands, by its speed and by its images."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from erfsfm.config import DataConfig
from erfsfm.data.discovery import open_drive
from erfsfm.data.recordings import Recording
from erfsfm.data.split import split_recordings
from erfsfm.data.standstill import moving_parts

CAMERA = "width: 208\nheight: 64\nfx: 150\nfy: 150\ncx: 104\ncy: 32\nfps: 10\n"
WriteDrive = Callable[..., Path]


def spans(recording: Recording) -> list[tuple[int, int]]:
    return [(part.start, part.start + len(part)) for part in moving_parts(recording)]


@pytest.mark.parametrize(
    ("speeds", "expected"),
    [
        ([10] * 6, [(0, 6)]),
        ([0] * 6, []),
        ([10, 10, 0, 0.3, 9, 9], [(0, 2), (4, 6)]),
        ([0, 0.6, 0, 0, 0, 5], [(1, 2), (5, 6)]),
    ],
)
def test_by_speed(tmp_path, write_raw, speeds, expected):
    for recording in open_drive(write_raw(tmp_path, speeds=speeds)):
        assert spans(recording) == expected


def test_parts_of_parts_keep_their_numbers(tmp_path, write_raw):
    left, _ = open_drive(write_raw(tmp_path, speeds=[9, 9, 9, 0, 9, 9, 9]))
    names = [part.frames_name for part in moving_parts(left.part(1, 6))]
    assert names == [f"{left.name}[1:3]", f"{left.name}[4:6]"]


def street(shift: int, traffic: int, gain: float, rng: np.random.Generator) -> np.ndarray:
    """A picture that the camera's motion shifts, with a car that passes, noise and an exposure."""
    grain = gaussian_filter(np.random.default_rng(0).normal(size=(64, 500)), 3.0)
    picture = 110 + 45 / grain.std() * grain[:, shift : shift + 208]
    picture[20:50, traffic : traffic + 50] = 230
    noisy = gain + picture + rng.normal(0, 1, picture.shape)
    return np.repeat(np.clip(noisy, 0, 255).astype(np.uint8)[..., None], 3, axis=2)


@pytest.mark.parametrize(
    ("broken", "kept"),
    [
        (None, [(0, 4), (7, 10)]),
        (0, [(0, 4), (7, 10)]),
        (4, [(0, 5), (7, 10)]),
        (5, [(0, 4), (5, 6), (7, 10)]),
    ],
)
def test_by_images_where_there_is_no_speed(tmp_path, write_raw, broken, kept):
    """Traffic, noise and exposure change while the car stands from frame 3 to 6: its images stay those of frame 3.

    An image that cannot be read is passed over: the next one is compared with the one before it.
    """
    drive = write_raw(tmp_path, speeds=None, frames=10, size=(64, 208))
    rng = np.random.default_rng(1)
    for index, shift in enumerate([0, 4, 8, 12, 12, 12, 12, 16, 20, 24]):
        brighter = 12 * (index % 2) if broken is None else 0
        image = street(shift, 10 * index, brighter, rng)
        cv2.imwrite(str(drive / "image_02/data" / f"{index:010d}.png"), image)
    if broken is not None:
        (drive / "image_02/data" / f"{broken:010d}.png").write_bytes(b"broken")
    recording, _ = open_drive(drive)
    assert recording.oxts is None and spans(recording) == kept


def test_by_images_at_night(tmp_path, write_raw):
    """A car that drives at night, under a plain sky, and stands from frame 3 to 6."""
    drive = write_raw(tmp_path, speeds=None, frames=10, size=(64, 208))
    rng = np.random.default_rng(1)
    for index, shift in enumerate([0, 1, 2, 3, 3, 3, 3, 4, 5, 6]):
        image = 0.2 * street(shift, 150, 0, rng)
        image[:30] = 4
        cv2.imwrite(str(drive / "image_02/data" / f"{index:010d}.png"), image)
    assert spans(open_drive(drive)[0]) == [(0, 4), (7, 10)]


def test_blank_images_stand_still(tmp_path, write_raw, recwarn):
    drive = write_raw(tmp_path, speeds=None, frames=3, size=(64, 208))
    for path in (drive / "image_02/data").iterdir():
        cv2.imwrite(str(path), np.zeros((64, 208, 3), np.uint8))
    assert spans(open_drive(drive)[0]) == [] and not recwarn.list


@pytest.mark.data
def test_real_recordings_never_stand_still(data_root):
    """A drive at 38 km/h and more: by speed and by images."""
    (drive,) = (data_root / "kitti_raw/2011_09_26").glob("*_0013_sync")
    (recording,) = open_drive(drive)
    assert spans(recording) == [(0, 144)]
    blind = Recording(recording.name, recording.images[:40], recording.camera)
    assert spans(blind) == [(0, 40)]


def test_of_a_camera_that_moves_little_every_nth_frame_is_taken(tmp_path, caplog):
    picture = street(0, 0, 0, np.random.default_rng(2))
    for index in range(120):
        shift = np.array([[1.0, 0.0, 0.03 * index], [0.0, 1.0, 0.0]])
        cv2.imwrite(str(tmp_path / f"{index:06d}.png"), cv2.warpAffine(picture, shift, (208, 64)))
    (tmp_path / "camera.yaml").write_text(CAMERA)
    ((part,), _) = split_recordings(DataConfig(roots=[tmp_path], validation=[]))
    assert f"every {part.stride}-th frame is taken" in caplog.text and part.number(len(part)) == 120


@pytest.mark.parametrize(("standing", "expected"), [(3, [(0, 60)]), (14, [(0, 20), (34, 60)])])
def test_a_doubled_frame_of_an_own_recording_is_no_stop(tmp_path, standing, expected):
    folder = tmp_path / "drive"
    (folder / "images").mkdir(parents=True)
    rng = np.random.default_rng(2)
    for index in range(60):
        shift = 4 * (index if index < 20 else max(19, index - standing))
        cv2.imwrite(str(folder / "images" / f"{index:06d}.png"), street(shift, 0, 0, rng))
    (folder / "camera.yaml").write_text(CAMERA)
    training, _ = split_recordings(DataConfig(roots=[folder], validation=[]))
    assert [(part.start, part.start + len(part)) for part in training] == expected
