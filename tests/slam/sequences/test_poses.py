"""True poses from a file of the user, for any recording; GPS tracks as they are written, and files that are none."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slam.commands.doctor import examine
from slam.formats.trajectory import Trajectory, write_kitti, write_tum
from slam.geometry.se3 import FloatArray, chain, from_rotation_vector
from slam.runtime.errors import SequenceError
from slam.sequences.catalogue import open_sequence
from slam.sequences.poses import read_gps

FRAMES = 8
NMEA = """$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47
$GPRMC,123519,A,4807.038,N,01131.000,E,022.4,084.4,230394,003.1,W*6A
$GPGGA,123520,4807.050,S,01131.000,W,0,00,,,M,,M,,
$GPGGA,123521,4807.050,S,01131.000,W,1,08,1.8,545.0,M,46.9,M,,
"""


def true_poses() -> FloatArray:
    rotation, step = np.zeros((2, FRAMES - 1, 3))
    rotation[:, 1], step[:, 2] = 0.02, 1.0
    return chain(from_rotation_vector(rotation, step))


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    folder = tmp_path / "walk" / "images"
    folder.mkdir(parents=True)
    for k in range(FRAMES):
        cv2.imwrite(str(folder / f"{k:03d}.png"), np.full((48, 64, 3), 10 * k, np.uint8))
    (folder / "camera.yaml").write_text(
        "{width: 64, height: 48, fx: 50, fy: 50, cx: 31.5, cy: 23.5, fps: 10}"
    )
    return folder


@pytest.fixture
def truth(tmp_path: Path) -> Path:
    return tmp_path / "truth.txt"


def reference(recording: Path, truth: Path, frames: str | None = None) -> FloatArray | None:
    return open_sequence(recording, frames=frames, truth=truth).reference


def test_a_row_a_frame(recording: Path, truth: Path) -> None:
    write_kitti(truth, Trajectory(np.arange(8.0), true_poses()))
    found = reference(recording, truth)
    assert found is not None
    np.testing.assert_allclose(found, true_poses(), atol=1e-6)
    part = reference(recording, truth, "3:6")
    assert part is not None
    np.testing.assert_allclose(part, np.linalg.inv(true_poses()[3]) @ true_poses()[3:6], atol=1e-6)


def test_rows_with_stamps_are_interpolated_at_the_frames(recording: Path, truth: Path) -> None:
    write_tum(truth, Trajectory(np.arange(0.0, 0.71, 0.1)[::2], true_poses()[::2]))
    found = reference(recording, truth, "0:7")
    assert found is not None
    np.testing.assert_allclose(found, true_poses()[:7], atol=0.02)


def test_rows_with_frame_numbers_are_of_these_frames(
    recording: Path, truth: Path, caplog: pytest.LogCaptureFixture
) -> None:
    rows = [f"{k} {' '.join(map(str, true_poses()[k, :3].ravel()))}\n" for k in range(3, FRAMES)]
    truth.write_text("".join(rows))
    assert reference(recording, truth) is None
    assert "has no pose of image 0" in caplog.text and "frames 2:8 have one each" in caplog.text
    part = reference(recording, truth, "2:8")
    assert part is not None
    np.testing.assert_allclose(part, np.linalg.inv(true_poses()[2]) @ true_poses()[2:], atol=0.1)


def test_poses_beside_a_folder_are_named_and_not_used(recording: Path) -> None:
    beside = recording.parent / "poses.kitti.txt"
    write_kitti(beside, Trajectory(np.arange(8.0), true_poses()))
    assert open_sequence(recording).reference is None
    line = examine(recording)[-1]
    assert f"no true poses (--truth {beside} gives some)" in line


def tum_rows() -> list[list[str]]:
    """Words of a file of all frames at 10 a second, the camera's rate."""
    poses = true_poses()
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    return [
        [f"{0.1 * k:.6f}", *map(repr, map(float, [*poses[k, :3, 3], *quaternions[k]]))]
        for k in range(FRAMES)
    ]


@pytest.mark.parametrize("wrong", ["nan", "cut off", "swapped", "reversed", "semicolons"])
def test_a_table_that_is_slightly_wrong_costs_no_reference(
    recording: Path, truth: Path, wrong: str
) -> None:
    rows = tum_rows()
    match wrong:
        case "nan":
            rows[4][1:] = ["nan"] * 7
        case "cut off":
            rows[-1] = rows[-1][:3]
        case "swapped":
            rows[3:5] = rows[4:2:-1]
        case "reversed":
            rows.reverse()
    truth.write_text("\n".join((";" if wrong == "semicolons" else " ").join(row) for row in rows))
    found = reference(recording, truth)
    assert found is not None
    np.testing.assert_allclose(found, true_poses(), atol=0.03)


def test_stamps_in_another_unit_are_named_and_divided_they_fit(
    recording: Path, truth: Path
) -> None:
    rows = tum_rows()
    truth.write_text("\n".join(" ".join([f"{1e6 * float(t):.1f}", *others]) for t, *others in rows))
    with pytest.raises(
        SequenceError, match=r"look like microseconds: divide them by 1e\+06"
    ) as caught:
        reference(recording, truth)
    by = float(str(caught.value).rpartition(" ")[2])
    table = np.loadtxt(truth)
    table[:, 0] /= by
    np.savetxt(truth, table)
    assert reference(recording, truth) is not None


def written(folder: Path, text: str) -> Path:
    path = folder / "track"
    path.write_text(text)
    return path


def test_csv(tmp_path: Path) -> None:
    text = "stamp, latitude, longitude, altitude\n0.0,49.0,8.4,115\n1.0,49.00001,8.4,115.5\n"
    track = read_gps(written(tmp_path, text))
    np.testing.assert_array_equal(track.stamps, [0.0, 1.0])
    np.testing.assert_array_equal(track.places, [[49.0, 8.4, 115.0], [49.00001, 8.4, 115.5]])
    np.testing.assert_array_equal(track.dilution, 1.0)


def test_nmea_without_fixes_that_are_none(tmp_path: Path) -> None:
    track = read_gps(written(tmp_path, NMEA))
    np.testing.assert_allclose(track.stamps, [45319.0, 45321.0])  # 12:35:19
    np.testing.assert_allclose(track.places[0], [48.1173, 11.516667, 545.4], atol=1e-6)
    np.testing.assert_allclose(track.places[1, :2], [-48.1175, -11.516667], atol=1e-6)
    np.testing.assert_array_equal(track.dilution, [0.9, 1.8])


def test_nmea_around_midnight_and_without_an_altitude(tmp_path: Path) -> None:
    fix = "$GPGGA,{},4807.038,N,01131.000,E,1,08,0.9,{},M,46.9,M,,\n"
    text = fix.format("235958", 545.4) + fix.format("235959", "") + fix.format("000001", 545.4)
    np.testing.assert_array_equal(read_gps(written(tmp_path, text)).stamps, [86398.0, 86401.0])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("time,lat\n1,2\n", "lacks stamp, latitude, longitude, altitude"),
        ("stamp,latitude,longitude,altitude\n", "holds no GPS fix"),
        ("stamp,latitude,longitude,altitude\n0,95,8,100\n", "line 2: no GPS fix"),
        ("stamp,latitude,longitude,altitude\n0,x,8,100\n", "line 2: no GPS fix"),
        ("stamp,latitude,longitude,altitude\n1,49,8,100\n1,49,8,100\n", "stamps must increase"),
        (
            "stamp,latitude,longitude,altitude\n1,49,8,100\n2,50,8,100\n3,51,8,100\n",
            "fixes move at 11119[45] m/s",
        ),
        ("$GPGGA,123519,48x07.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,", "line 1: no GPS fix"),
    ],
)
def test_what_is_no_track(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(SequenceError, match=said):
        read_gps(written(tmp_path, text))


def test_bad_fixes_are_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    rows = [f"{k},49.000{k},8,100" for k in range(8)]
    rows[3], rows[5] = "3,nan,8,100", "4,49.0004,8,100"
    (tmp_path / "track").write_text("\n".join(["stamp,latitude,longitude,altitude", *rows, "9,,,"]))
    assert read_gps(tmp_path / "track").stamps.tolist() == [0, 1, 2, 4, 6, 7]
    assert "3 of 9 rows" in caplog.text and "line 5" in caplog.text
