"""Trajectory files in and out, what is wrong with them in one line, and the matching of two."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slam.formats.trajectory import (
    Trajectory,
    associate,
    matching_tolerance_s,
    read_trajectory,
    write_kitti,
    write_tum,
)
from slam.geometry import se3
from slam.runtime.errors import TrajectoryError

KITTI = "1 0 0 1.5 0 1 0 2.5 0 0 1 3.5"
TUM = "0.1 1.5 2.5 3.5 0 0 0 1"


def wander(count: int, period: float = 0.1, seed: int = 0) -> Trajectory:
    rng = np.random.default_rng(seed)
    T_world_camera = se3.make(
        Rotation.random(count, rng=rng).as_matrix(), rng.normal(scale=100, size=(count, 3))
    )
    return Trajectory(period * np.arange(count, dtype=np.float64), T_world_camera)


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "poses.txt"
    path.write_text(text)
    return path


def test_length_and_rebasing():
    places = np.array([[1.0, 1.0, 1.0], [1.0, 1.0, 4.0], [1.0, 5.0, 4.0]])
    turn = Rotation.from_rotvec([0.0, np.pi / 2, 0.0]).as_matrix()
    trajectory = Trajectory(np.array([0.0, 1.0, 2.0]), se3.make(np.tile(turn, (3, 1, 1)), places))
    assert trajectory.length_m == pytest.approx(7.0)
    rebased = trajectory.rebased()
    np.testing.assert_allclose(rebased.T_world_camera[0], np.eye(4), atol=1e-15)
    np.testing.assert_allclose(rebased.positions, [[0, 0, 0], [-3, 0, 0], [-3, 4, 0]], atol=1e-14)
    assert rebased.length_m == pytest.approx(7.0)
    assert len(trajectory.select(np.array([0, 2]))) == 2


@pytest.mark.parametrize("format", ["auto", "kitti"])
def test_kitti_round_trip(tmp_path: Path, format: str):
    trajectory = wander(7)
    write_kitti(tmp_path / "new" / "poses.txt", trajectory)
    back = read_trajectory(tmp_path / "new" / "poses.txt", format)
    np.testing.assert_allclose(back.T_world_camera, trajectory.T_world_camera, rtol=1e-9, atol=1e-8)
    np.testing.assert_array_equal(back.stamps, np.arange(7))
    assert not back.timed


@pytest.mark.parametrize("format", ["auto", "tum"])
def test_tum_round_trip_keeps_every_digit_of_a_stamp(tmp_path: Path, format: str):
    trajectory = wander(7)
    stamps = 1311868164.3631 + 0.1037 * np.arange(7, dtype=np.float64)
    write_tum(tmp_path / "poses.txt", Trajectory(stamps, trajectory.T_world_camera))
    back = read_trajectory(tmp_path / "poses.txt", format)
    np.testing.assert_allclose(back.T_world_camera, trajectory.T_world_camera, rtol=1e-8, atol=1e-8)
    np.testing.assert_array_equal(back.stamps, stamps)
    assert back.timed


@pytest.mark.parametrize(
    ("text", "format", "words"),
    [
        ("", "auto", "no row"),
        ("1 2 3\n", "auto", "line 1: 3 columns; a KITTI row has 12, a TUM row 8"),
        (TUM, "kitti", "line 1: 8 columns; a KITTI row has 12, a TUM row 8"),
        (KITTI, "tum", "line 1: 12 columns; a KITTI row has 12, a TUM row 8"),
        ("1 0 0 0 0 1 0 0 0 0 -1 0", "auto", "line 1: the 3x3 part is not a rotation"),
        (
            "1e200 1e200 0 0 -1e200 1e200 0 0 0 0 1 0",
            "auto",
            "line 1: the 3x3 part is not a rotation",
        ),
        ("0 0 0 0 0 0 0 0", "auto", "line 1: the quaternion does not have length 1"),
        (
            TUM.replace(".", ","),
            "auto",
            "line 1: not a finite number: '0,1'; decimals are written with a point",
        ),
        (f"{TUM}\n{TUM}\n", "auto", "line 2: time stamps must increase"),
        (
            "".join(f"{k} 0 0 0 0 0 0 1\n" for k in (1, 2, 3, 4, 1, 2, 3, 4)),
            "auto",
            "line 5: time stamps must increase",
        ),
        (TUM, "euroc", "unknown trajectory format 'euroc'"),
    ],
)
def test_what_is_wrong_is_one_line(tmp_path: Path, text: str, format: str, words: str):
    with pytest.raises(TrajectoryError, match=words.replace("(", r"\(")) as error:
        read_trajectory(written(tmp_path, text), format)
    assert "\n" not in str(error.value)


def test_rows_without_stamps_keep_their_places_where_others_are_bad(tmp_path: Path):
    truth = wander(10)
    write_kitti(tmp_path / "truth.txt", truth)
    rows = (tmp_path / "truth.txt").read_text().splitlines()
    rows[2], rows[9] = " ".join(["nan"] * 12), rows[9][:50]
    damaged = read_trajectory(written(tmp_path, "\n".join(rows)))
    assert damaged.frame_count == 10
    ours, theirs = associate(read_trajectory(tmp_path / "truth.txt"), damaged)
    np.testing.assert_allclose(ours.T_world_camera, theirs.T_world_camera)
    np.testing.assert_allclose(ours.positions, truth.positions[[0, 1, 3, 4, 5, 6, 7, 8]], atol=1e-8)
    with pytest.raises(TrajectoryError, match="11 poses and the reference 10"):
        associate(Trajectory(np.arange(11.0), wander(11).T_world_camera, timed=False), damaged)


@pytest.mark.parametrize("numbered", [False, True])
def test_rows_of_whole_matrices(tmp_path: Path, numbered: bool):
    trajectory = wander(4)
    rows = trajectory.T_world_camera.reshape(4, 16)
    np.savetxt(
        tmp_path / "poses.txt", np.column_stack([np.arange(4) * 2, rows]) if numbered else rows
    )
    read = read_trajectory(tmp_path / "poses.txt")
    np.testing.assert_allclose(read.T_world_camera, trajectory.T_world_camera, atol=1e-9)
    np.testing.assert_array_equal(read.frame_numbers, np.arange(4) * (2 if numbered else 1))


@pytest.mark.parametrize("header", ["#timestamp,p_RS_R_x [m]", "timestamp,x,y,z,qw,qx,qy,qz"])
def test_the_true_poses_of_euroc(tmp_path: Path, header: str):
    row = "14037152{}3262142976,1.5,2.5,3.5,0.6,0.8,0,0,9,9,9,9,9,9,9,9,9"
    read = read_trajectory(written(tmp_path, "\n".join([header, row.format(7), row.format(8)])))
    assert read.timed and read.stamps[0] == 1403715273.262142976
    write_tum(tmp_path / "tum.txt", read)
    assert (tmp_path / "tum.txt").read_text().splitlines()[1].split()[4:] == [
        *("8.000000000e-01", "0.000000000e+00", "0.000000000e+00", "6.000000000e-01")
    ]


@pytest.mark.parametrize(
    "row", ["1.0003 0 0 0 0 0.9998 0.0002 0 0 0 1 0", "0 0 0 0 0 0 0.7071 0.7071"]
)
def test_rounded_rotations_are_repaired(tmp_path: Path, row: str):
    assert se3.is_se3(read_trajectory(written(tmp_path, row)).T_world_camera, tolerance=1e-12)


def test_untimed_trajectories_match_row_by_row():
    timed = wander(4)
    untimed = Trajectory(10 * timed.stamps, timed.T_world_camera, timed=False)
    assert associate(untimed, timed) == (untimed, timed)
    with pytest.raises(TrajectoryError, match=r"4 poses and the reference 5.*TUM files") as error:
        associate(untimed, wander(5))
    assert "\n" not in str(error.value)


def test_rows_with_frame_numbers_match_the_rows_of_the_reference(tmp_path: Path):
    rows = "".join(f"{k} 1 0 0 {k} 0 1 0 0 0 0 1 0\n" for k in (2, 3, 7))
    estimate = read_trajectory(written(tmp_path, rows))
    assert estimate.numbered and not estimate.timed
    reference = Trajectory(np.arange(10.0), wander(10).T_world_camera, timed=False)
    ours, truth = associate(estimate, reference)
    np.testing.assert_array_equal(ours.positions[:, 0], [2, 3, 7])
    np.testing.assert_array_equal(truth.T_world_camera, reference.T_world_camera[[2, 3, 7]])
    ours, truth = associate(estimate, reference, (3, 10))
    np.testing.assert_array_equal(ours.positions[:, 0], [3, 7])
    with pytest.raises(TrajectoryError, match="no poses of frames 4:6, only 2 to 7"):
        associate(estimate, reference, (4, 6))
    with pytest.raises(TrajectoryError, match="line 4: frame numbers must increase"):
        read_trajectory(written(tmp_path, rows + rows))


def test_frames_cut_the_reference_and_a_file_of_as_many_rows_is_of_these_frames():
    reference = Trajectory(np.arange(10.0), wander(10).T_world_camera, timed=False)
    for estimate in (reference, reference.select(np.arange(4, 8))):
        ours, truth = associate(estimate, reference, (4, 8))
        np.testing.assert_array_equal(ours.T_world_camera, reference.T_world_camera[4:8])
        np.testing.assert_array_equal(truth.T_world_camera, reference.T_world_camera[4:8])


def test_seven_columns_are_a_camera_that_looks_along_x(tmp_path: Path):
    """TartanVO's: ahead, right and down are x, y and z; a turn to the right is about its z."""
    half = np.sin(np.pi / 4)
    poses = read_trajectory(
        written(tmp_path, f"1 2 3 0 0 0 1\n1 2 3 0 0 {half} {half}\n")
    ).T_world_camera
    np.testing.assert_allclose(poses[0], se3.make(np.eye(3), np.array([2.0, 3.0, 1.0])), atol=1e-12)
    np.testing.assert_allclose(poses[1, :3, :3] @ [0, 0, 1], [1, 0, 0], atol=1e-12)


def test_stamps_match_one_to_one_within_half_a_period():
    reference = wander(50)
    stamps = reference.stamps[10:40:2] + 0.03
    estimate, matched = associate(Trajectory(stamps, reference.T_world_camera[10:40:2]), reference)
    np.testing.assert_array_equal(estimate.stamps, stamps)
    np.testing.assert_allclose(matched.T_world_camera, reference.at(stamps).T_world_camera)
    assert matching_tolerance_s(estimate, reference) == pytest.approx(0.05)
