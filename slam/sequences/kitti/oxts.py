"""KITTI's GPS/INS packets (OXTS) as poses.

Geiger et al. 2013, section IV: the IMU looks forward along x, left along y, up along z; the world here is
east, north, up in a Mercator projection scaled at the first latitude.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from erfsfm.common.readers.kitti_sensors import VELOCITY_EAST, VELOCITY_NORTH, VELOCITY_UP
from slam.geometry import se3
from slam.geometry.se3 import FloatArray

_EARTH_RADIUS_M = 6378137.0
_RATES = slice(17, 20)


def T_world_imu(packets: FloatArray, ages_s: FloatArray) -> FloatArray:
    """Poses of the IMU ``(N, 4, 4)``, east-north-up, metres.

    Args:
        packets: rows of OXTS, ``(N, 30)``.
        ages_s: how long before its image each packet was taken, seconds, ``(N,)``, negative for one taken
            after it; the pose is extrapolated to the image with the packet's velocity and angular rate.
            Packets and images differ by up to 14 ms, which at 40 km/h is 15 cm.
    """
    latitude, longitude, altitude = np.deg2rad(packets[:, 0]), np.deg2rad(packets[:, 1]), packets[:, 2]
    scale = np.cos(latitude[0])
    east = scale * _EARTH_RADIUS_M * longitude
    north = scale * _EARTH_RADIUS_M * np.log(np.tan(np.pi / 4 + latitude / 2))
    velocity = packets[:, [VELOCITY_EAST, VELOCITY_NORTH, VELOCITY_UP]]
    positions = np.column_stack([east, north, altitude]) + velocity * ages_s[:, None]
    yaw_pitch_roll = packets[:, [5, 4, 3]]
    turn = Rotation.from_rotvec(packets[:, _RATES] * ages_s[:, None])
    R_world_imu = Rotation.from_euler("ZYX", yaw_pitch_roll) * turn
    return se3.make(R_world_imu.as_matrix(), positions)
