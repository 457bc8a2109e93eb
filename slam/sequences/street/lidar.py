"""A spinning 64-beam LiDAR on the roof."""

from __future__ import annotations

import numpy as np

from slam.sequences.street.geometry import Float32Array, FloatArray

BEAMS, COLUMNS = 64, 800
HIGHEST_DEG, LOWEST_DEG = 2.0, -24.8
MAX_RANGE_M, MIN_RANGE_M = 90.0, 2.0
RANGE_NOISE_M, ELEVATION_NOISE = 0.02, 1e-3

# x forward, y left, z up; 8 cm above and 27 cm behind the camera, as on KITTI's car
T_CAMERA_LIDAR: FloatArray = np.array(
    [[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, -0.08], [1.0, 0.0, 0.0, -0.27], [0.0, 0.0, 0.0, 1.0]]
)


def beam_directions(rng: np.random.Generator) -> Float32Array:
    """Unit directions ``(BEAMS * COLUMNS, 3)`` in the LiDAR frame.

    The spin starts at a random angle: with the same rays in every scan, rings on the ground repeat
    exactly and scan matching believes that the car stands still.
    """
    azimuth = np.arange(COLUMNS) * (2 * np.pi / COLUMNS) + rng.uniform(0, 2 * np.pi / COLUMNS)
    elevation = np.deg2rad(np.linspace(HIGHEST_DEG, LOWEST_DEG, BEAMS))[:, None]
    elevation = elevation + rng.normal(0, ELEVATION_NOISE, (BEAMS, COLUMNS))
    directions = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=-1
    )
    return directions.reshape(-1, 3).astype(np.float32)


def measured(
    directions: Float32Array, ranges: Float32Array, brightness: Float32Array, rng: np.random.Generator
) -> Float32Array:
    """Points of a scan ``(M, 4)``: x, y, z in the LiDAR frame with noise, and reflectance in [0, 1]."""
    kept = (ranges > MIN_RANGE_M) & (ranges < MAX_RANGE_M)
    noisy = ranges[kept] + rng.normal(0, RANGE_NOISE_M, int(kept.sum()))
    return np.column_stack([directions[kept] * noisy[:, None], brightness[kept]]).astype(np.float32)
