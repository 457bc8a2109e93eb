"""What measures in a world: the camera and its pixels, and a spinning 64-beam LiDAR on the roof."""

import numpy as np

from slam.frames import Intrinsics
from slam.simulation.geometry import Float32Array, FloatArray

# KITTI odometry 00-02 (rectified colour camera), at the size it was recorded at
KITTI_CAMERA = Intrinsics(1241, 376, 718.856, 718.856, 607.1928, 185.2157)


def square_camera(width: int, height: int, fov_deg: float) -> Intrinsics:
    """Of square pixels with a horizontal field of view, its centre in the middle."""
    focal_px = float(0.5 * width / np.tan(0.5 * np.deg2rad(fov_deg)))
    return Intrinsics(width, height, focal_px, focal_px, 0.5 * (width - 1), 0.5 * (height - 1))


def footprint(
    pixel: Float32Array, rays: Float32Array, normals: Float32Array, tangents: Float32Array
) -> tuple[Float32Array, Float32Array]:
    """Extent of a pixel on a surface along its u and v axes, grazing angle included.

    A round pixel of size f ``(N,)``, metres at the surface's distance, seen by rays at angle a to the normals is an
    ellipse of axes f and f / cos a; along a tangent t it extends f sqrt(1 + (ray . t)^2 / cos^2 a). All directions are
    unit, ``(3, N)``.
    """
    cosine = np.abs((rays * normals).sum(axis=0))
    along_u = (rays * tangents).sum(axis=0)
    cosine2 = np.maximum(cosine * cosine, 1e-4)
    u2 = along_u * along_u
    v2 = np.maximum(1.0 - cosine * cosine - u2, 0.0)
    return pixel * np.sqrt(1.0 + u2 / cosine2), pixel * np.sqrt(1.0 + v2 / cosine2)


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

    Of rays in unit directions ``(N, 3)``, with exact ranges ``(N,)``, infinite where nothing was hit.
    """
    kept = (ranges_m > NEAREST_M) & (ranges_m < FARTHEST_M)
    noisy = ranges_m[kept] + rng.normal(0.0, RANGE_NOISE_M, int(kept.sum()))
    return np.column_stack([directions[kept] * noisy[:, None], reflectance[kept]]).astype(np.float32)
