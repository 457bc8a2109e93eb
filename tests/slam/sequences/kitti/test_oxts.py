import numpy as np
import pytest

from slam.sequences import kitti as oxts


def packet(**columns: float) -> np.ndarray:
    names = ["lat", "lon", "alt", "roll", "pitch", "yaw", "vn", "ve", "vf", "vl", "vu"]
    names += ["ax", "ay", "az", "af", "al", "au", "wx", "wy", "wz"]
    row = np.zeros(30)
    row[0] = 49.0
    for name, value in columns.items():
        row[names.index(name)] = value
    return row


def test_axes_by_hand() -> None:
    """Yaw 0 looks east and grows to the north; pitch puts the nose down, roll the left side up."""
    packets = np.stack(
        [packet(), packet(yaw=np.pi / 2), packet(pitch=0.1), packet(roll=0.1)],
    )
    R = oxts.T_world_imu(packets, np.zeros(4))[:, :3, :3]
    assert R[0] == pytest.approx(np.eye(3))
    assert R[1] @ [1, 0, 0] == pytest.approx([0, 1, 0], abs=1e-12)  # forward is north
    assert (R[2] @ [1, 0, 0])[2] == pytest.approx(-np.sin(0.1))  # nose down
    assert (R[3] @ [0, 1, 0])[2] == pytest.approx(np.sin(0.1))  # left side up


def test_a_step_north_and_east_in_metres() -> None:
    step = 1e-5
    packets = np.stack([packet(), packet(lat=49 + step), packet(lon=step)])
    t = oxts.T_world_imu(packets, np.zeros(3))[:, :3, 3]
    assert t[1] - t[0] == pytest.approx([0, 6378137 * np.deg2rad(step), 0], abs=1e-5)
    assert t[2] - t[0] == pytest.approx([6378137 * np.deg2rad(step) * np.cos(np.deg2rad(49)), 0, 0], abs=1e-5)


def test_packets_are_extrapolated_to_their_image() -> None:
    moving = packet(vn=1.0, ve=2.0, vu=3.0, wz=0.5)[None]
    T = oxts.T_world_imu(np.concatenate([moving, moving]), np.array([0.0, 0.01]))
    assert T[1, :3, 3] - T[0, :3, 3] == pytest.approx([0.02, 0.01, 0.03])
    assert np.arctan2(T[1, 1, 0], T[1, 0, 0]) == pytest.approx(0.005)
