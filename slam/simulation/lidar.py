"""A spinning 64-beam LiDAR on the roof: its rays and the noise of its ranges."""

import numpy as np

from slam.simulation.geometry import Float32Array, FloatArray

BEAMS, COLUMNS = 64, 850
HIGHEST_DEG, LOWEST_DEG = 2.0, -24.8
NEAREST_M, FARTHEST_M = 2.0, 90.0
RANGE_NOISE_M, ELEVATION_NOISE = 0.02, 1e-3

# LiDAR: x forward, y left, z up; 8 cm above and 27 cm behind the camera, as on KITTI's car
T_CAMERA_LIDAR: FloatArray = np.array(
    [[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, -0.08], [1.0, 0.0, 0.0, -0.27], [0.0, 0.0, 0.0, 1.0]]
)


def beam_directions(rng: np.random.Generator) -> Float32Array:
    """Unit directions of one spin in the LiDAR frame, ``(BEAMS * COLUMNS, 3)``.

    Each spin starts at a random angle: with the same rays in every scan the rings on the ground would repeat
    exactly, and scan matching would estimate zero motion.
    """
    azimuth = (np.arange(COLUMNS) + rng.uniform()) * (2.0 * np.pi / COLUMNS)
    elevation = np.deg2rad(np.linspace(HIGHEST_DEG, LOWEST_DEG, BEAMS))[:, None]
    elevation = elevation + rng.normal(0.0, ELEVATION_NOISE, (BEAMS, COLUMNS))
    directions = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=-1
    )
    return directions.reshape(-1, 3).astype(np.float32)


def measured(
    directions: Float32Array, ranges_m: Float32Array, reflectance: Float32Array, rng: np.random.Generator
) -> Float32Array:
    """Points x, y, z (LiDAR frame, metres) and reflectance in [0, 1] of the rays that came back, ``(M, 4)``.

    Args:
        directions: unit, LiDAR frame, ``(N, 3)``.
        ranges_m: exact, infinite where nothing was hit, ``(N,)``.
        reflectance: of what was hit, ``(N,)``.
        rng: of the range noise.
    """
    kept = (ranges_m > NEAREST_M) & (ranges_m < FARTHEST_M)
    noisy = ranges_m[kept] + rng.normal(0.0, RANGE_NOISE_M, int(kept.sum()))
    return np.column_stack([directions[kept] * noisy[:, None], reflectance[kept]]).astype(np.float32)
