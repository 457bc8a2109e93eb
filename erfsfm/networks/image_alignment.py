"""Rotations of a pose network's guess measured in the images, and its path bent accordingly.

Between neighbouring frames cells of the image are followed from coarse to fine (Lucas and Kanade 1981), beginning where
the guessed motion over a road would carry them. The rotation by which the rays of all cells meet follows by least
squares; the depth of a cell is known hardly at all, so that parallax of something near is not taken for a turn. Where
an image shows nothing to follow, the guess stays.

Within a snippet a camera moves steadily: its path is made of equal steps in the guessed direction of travel, which
turns with the camera. Nothing here is learned, and all of it is tensors and plain operators, so that networks can be
exported.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from erfsfm.geometry import euler_to_rotation

Alignment = Literal["none", "images"]


class _Level(NamedTuple):
    """One size of the images: how often halved, pixels from cell to cell and of a cell, and iterations."""

    halvings: int
    stride: int
    cell: int
    iterations: int


_LEVELS = (_Level(3, 2, 6, 2), _Level(2, 2, 6, 2), _Level(1, 4, 8, 1))
_GREY_STEPS = 127.5  # of 8 bits, in a unit of colours in [-1, 1]
_LEAST_TEXTURE = 1.0  # mean squared gradient of a cell that is followed hesitatingly, (8-bit steps / pixel)^2
_GREY_NOISE = 2.0  # 8-bit steps
_INDEPENDENT = 8.0  # pixels of a cell whose noise is independent of the others'
_SUREST = 0.15  # pixels of the whole image: sigma of a perfect match
_LARGEST_STEP = 2.0  # pixels of a level, in one iteration
_SHOWN = 0.75  # of a cell's height and width, for it to count
_CAMERA_HEIGHT = 0.07  # roughly, in the unit of a pose network that was taught lengths
_FARTHEST = 0.2  # inverse depth of what is not road
_DEPTH_SIGMA = 4.0  # relative
_OUTLIERS = (4.0, 1.5)  # of the linearisations, in NOISE


def aligned(vectors: Tensor, target: Tensor, sources: Sequence[Tensor]) -> Tensor:
    """The motion with rotations measured in the images, and a steady path along them in the guessed direction.

    Args:
        vectors: guessed pose vectors ``(B, N, 6)``.
        target: colours in [-1, 1], ``(B, 3, H, W)``, H and W multiples of 32.
        sources: N images like the target, in time order.

    Returns:
        Pose vectors ``(B, N, 6)``.
    """
    with torch.autocast(target.device.type, enabled=False):
        images = [image[:, 1:2].float() for image in (target, *sources)]  # green, the sharpest of a colour camera
        return _aligned(vectors.float(), images[0], images[1:])


def _aligned(vectors: Tensor, target: Tensor, sources: list[Tensor]) -> Tensor:
    middle, count = len(sources) // 2, len(sources)
    images = torch.stack([*sources[:middle], target, *sources[middle:]], dim=1)
    R_all = _inserted(euler_to_rotation(vectors[..., 3:]), torch.eye(3, device=vectors.device), middle)
    t_all = _inserted(vectors[..., :3], torch.zeros(3, device=vectors.device), middle)
    R_step = R_all[:, 1:] @ R_all[:, :-1].transpose(-1, -2)  # each frame in the next one's camera
    t_step = t_all[:, 1:] - _turned(R_step, t_all[:, :-1])
    # a step in the camera halfway, whose axes are the means of those of the cameras before and after
    travel = ((t_step + _turned(R_step.transpose(-1, -2), t_step)) / 2).mean(dim=1, keepdim=True)
    R_step = _rotations(images, R_step.flatten(0, 1), t_step.flatten(0, 1)).reshape(R_step.shape)
    t_step = (travel + _turned(R_step, travel.expand_as(t_step))) / 2
    R, t = [torch.eye(3, device=vectors.device).expand_as(R_step[:, 0])], [torch.zeros_like(t_step[:, 0])]
    for k in range(middle - 1, -1, -1):
        R_back = R_step[:, k].transpose(-1, -2)
        t.insert(0, _turned(R_back, t[0] - t_step[:, k]))
        R.insert(0, R_back @ R[0])
    for k in range(middle, count):
        t.append(_turned(R_step[:, k], t[-1]) + t_step[:, k])
        R.append(R_step[:, k] @ R[-1])
    del R[middle], t[middle]
    return torch.cat([torch.stack(t, dim=1), rotation_to_euler(torch.stack(R, dim=1))], dim=-1)


def _rotations(images: Tensor, R: Tensor, t: Tensor) -> Tensor:
    """Rotations ``(B * N, 3, 3)`` from each frame of ``(B, N + 1, 1, H, W)`` to the next, from guessed motions."""
    size = (int(images.shape[-2]), int(images.shape[-1]))  # constants in an exported graph
    flow, information = _followed(_levels(images), _guess(R, t, size))
    h, w = flow.shape[-2:]
    rays = cell_rays(h, w, images.device)
    scale = torch.tensor([FOCAL[0] * size[1], FOCAL[1] * size[0]], device=images.device)
    seen = rays[:, :2] + flow.flatten(2).transpose(1, 2) / scale
    weights = information.flatten(2).transpose(1, 2) * scale**2
    weights = NOISE**2 * weights / (1 + (_SUREST / scale) ** 2 * weights)
    inverse_depth = _road(rays).expand(len(R), -1)
    R, _ = align(seen, weights, rays, (inverse_depth, _DEPTH_SIGMA * inverse_depth), (R, t), _OUTLIERS)
    return R


def _guess(R: Tensor, t: Tensor, size: tuple[int, int]) -> Tensor:
    """Flow ``(B, 2, h, w)`` in pixels of the image on the cells of the coarsest level, by guessed motions."""
    h, w = (pixels // 2 ** _LEVELS[0].halvings // _LEVELS[0].stride for pixels in size)
    rays = cell_rays(h, w, R.device)
    _, at, _ = project(rays, _road(rays).expand(len(R), -1), R, t)
    pixels = torch.tensor([FOCAL[0] * size[1], FOCAL[1] * size[0]], device=R.device)
    return ((at - rays[:, :2]) * pixels).transpose(1, 2).reshape(len(R), 2, h, w)


def _road(rays: Tensor) -> Tensor:
    """Inverse depth ``(P,)`` of a level road, and of something far above it."""
    return (rays[:, 1] / _CAMERA_HEIGHT).clamp(min=_FARTHEST)


def _levels(images: Tensor) -> list[tuple[Tensor, Tensor]]:
    """Frames ``(B * N, 1, h, w)`` and those that follow, without their local mean, by level as in `_LEVELS`."""
    pyramid = {1: F.avg_pool2d(_GREY_STEPS * images.flatten(0, 1), 2)}
    for halvings in range(2, _LEVELS[0].halvings + 3):
        pyramid[halvings] = F.avg_pool2d(pyramid[halvings - 1], 2)
    levels = []
    for level in _LEVELS:
        mean = F.interpolate(pyramid[level.halvings + 2], scale_factor=4.0, mode="bilinear")
        frames = (pyramid[level.halvings] - mean).unflatten(0, images.shape[:2])
        levels.append((frames[:, :-1].flatten(0, 1), frames[:, 1:].flatten(0, 1)))
    return levels


def _followed(levels: list[tuple[Tensor, Tensor]], guess: Tensor) -> tuple[Tensor, Tensor]:
    """Flow ``(B, 2, h, w)`` of the finest level's cells in pixels of the image, and its information."""
    flow, before = guess, 0
    for level, (first, second) in zip(_LEVELS, levels):
        flow = flow * 2.0 ** (before - level.halvings)
        if before:
            size = (int(first.shape[-2]) // level.stride, int(first.shape[-1]) // level.stride)
            flow = F.interpolate(flow, size=size, mode="bilinear")
        flow, information = _improved(first, second, flow, level)
        before = level.halvings
    return flow * 2.0**before, information / 4.0**before


def _improved(first: Tensor, second: Tensor, flow: Tensor, level: _Level) -> tuple[Tensor, Tensor]:
    """Flow of cells in pixels after some iterations of Lucas and Kanade, and information of both its coordinates."""
    h, w = int(first.shape[-2]), int(first.shape[-1])
    rows, columns = (torch.arange(n, device=flow.device).float() for n in (h, w))
    places = torch.stack([columns.expand(h, w), rows.unsqueeze(-1).expand(h, w)])
    edges = torch.tensor([float(w), float(h)], device=flow.device).reshape(2, 1, 1)

    def mean(*values: Tensor) -> list[Tensor]:
        """Over each cell; cells overlap."""
        margin = (level.cell - level.stride) // 2
        return list(F.avg_pool2d(torch.cat(values, dim=1), level.cell, level.stride, margin).split(1, dim=1))

    wide = F.pad(first, (1, 1, 1, 1), mode="replicate")  # for central differences ``(B, 1, h, w)``
    g_x = (wide[..., 1:-1, 2:] - wide[..., 1:-1, :-2]) / 2
    g_y = (wide[..., 2:, 1:-1] - wide[..., :-2, 1:-1]) / 2
    xx, xy, yy = mean(g_x * g_x, g_x * g_y, g_y * g_y)
    m_xx, m_yy = xx + _LEAST_TEXTURE, yy + _LEAST_TEXTURE
    determinant = m_xx * m_yy - xy * xy
    for _ in range(level.iterations):
        at = places + F.interpolate(flow, size=(h, w), mode="bilinear")
        grid = ((2 * at + 1) / edges - 1).permute(0, 2, 3, 1)
        error = F.grid_sample(second, grid, mode="bilinear", align_corners=False) - first
        x, y, square = mean(g_x * error, g_y * error, error * error)
        step = torch.cat([xy * y - m_yy * x, xy * x - m_xx * y], dim=1) / determinant
        flow = flow + step.clamp(-_LARGEST_STEP, _LARGEST_STEP)
    from_middle = (F.avg_pool2d(places, level.stride) + flow - (edges - 1) / 2).abs()
    counted = (from_middle < edges / 2 - level.cell * (_SHOWN - 0.5)).all(dim=1, keepdim=True).to(first.dtype)
    variance = (square + _GREY_NOISE**2) / _INDEPENDENT
    return flow, torch.cat([xx, yy], dim=1) * counted / variance


def _inserted(values: Tensor, between: Tensor, middle: int) -> Tensor:
    """Values ``(B, N, ...)`` of the sources with the target's own in the middle."""
    own = between.expand(len(values), 1, *between.shape)
    return torch.cat([values[:, :middle], own, values[:, middle:]], dim=1)


def _turned(R: Tensor, vectors: Tensor) -> Tensor:
    """Rotations ``(..., 3, 3)`` of vectors ``(..., 3)``."""
    return (R @ vectors.unsqueeze(-1)).squeeze(-1)


# An image does not show its camera: viewing rays are those of KITTI's, in image widths and heights.
FOCAL = (0.58, 1.92)
CENTRE = (0.495, 0.48)
NOISE = 0.005  # unit of sigmas on the image plane: 1.2 pixels of 416
DAMPING = 1e-4  # keeps the motion of a blank image finite
LARGEST_STEP = 0.3  # radians, or units of length, in one iteration
NEAREST = 0.1  # of a point's depth after the motion over that before


def cell_rays(rows: int, columns: int, device: torch.device) -> Tensor:
    """Viewing rays ``(rows * columns, 3)`` of the centres of the cells that an image is divided into, with z = 1.

    Args:
        rows: of a feature map.
        columns: of a feature map.
        device: of the rays.
    """
    y = ((torch.arange(rows, device=device) + 0.5) * (1 / rows) - CENTRE[1]) / FOCAL[1]
    x = ((torch.arange(columns, device=device) + 0.5) * (1 / columns) - CENTRE[0]) / FOCAL[0]
    x, y = x.repeat(rows), y.repeat_interleave(columns)
    return torch.stack([x, y, torch.ones_like(x)], dim=-1)


def project(rays: Tensor, inverse_depth: Tensor, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Points of a target seen from its source.

    Args:
        rays: ``(P, 3)``.
        inverse_depth: ``(B, P)``.
        R: of ``T_source_target``, ``(B, 3, 3)``.
        t: of ``T_source_target``, ``(B, 3)``.

    Returns:
        Rotated rays ``(B, P, 3)``, positions on the source's image plane ``(B, P, 2)``, and ``(B, P)`` one over the
        ratio of the depths.
    """
    turned = rays @ R.transpose(-1, -2)
    x, y, z = (turned + inverse_depth.unsqueeze(-1) * t.unsqueeze(-2)).unbind(-1)
    nearer = 1 / z.clamp(min=NEAREST)
    return turned, torch.stack([x * nearer, y * nearer], dim=-1), nearer


def align(
    seen: Tensor,
    information: Tensor,
    rays: Tensor,
    inverse_depth: tuple[Tensor, Tensor],
    motion: tuple[Tensor, Tensor],
    outliers: Sequence[float],
) -> tuple[Tensor, Tensor]:
    """Motion that carries points to where they were seen, by Gauss and Newton.

    What an error of the inverse depth would explain is discounted (the Schur complement of each point's own
    inverse depth), so that a wrong depth of something near does not turn the camera.

    Args:
        seen: of each point on the source's image plane, ``(B, P, 2)``.
        information: inverse variances of both coordinates, ``(B, P, 2)``, in ``NOISE ** -2``.
        rays: of the points, ``(P, 3)``.
        inverse_depth: and its sigma, each ``(B, P)``.
        motion: rotation ``(B, 3, 3)`` and translation ``(B, 3)`` of ``T_source_target`` to start from.
        outliers: for each linearisation, the error in ``NOISE`` at which a point counts half (Cauchy's weights).
    """
    (R, t), (value, sigma) = motion, inverse_depth
    identity = torch.eye(6, device=seen.device)
    for outlier in outliers:
        wx, wy = information.unbind(-1)
        turned, at, nearer = project(rays, value, R, t)
        (x, y), (a, b, c) = at.unbind(-1), turned.unbind(-1)
        shift, none = nearer * value, torch.zeros_like(x)
        J_x = torch.stack([-nearer * x * b, nearer * (c + x * a), -nearer * b, shift, none, -x * shift], dim=-1)
        J_y = torch.stack([-nearer * (c + y * b), nearer * y * a, nearer * a, none, shift, -y * shift], dim=-1)
        by_depth_x = nearer * (t[:, None, 0] - x * t[:, None, 2])
        by_depth_y = nearer * (t[:, None, 1] - y * t[:, None, 2])
        r_x, r_y = (seen - at).unbind(-1)
        prior = (NOISE / sigma) ** 2
        error = wx * r_x**2 + wy * r_y**2
        error = error - (wx * by_depth_x * r_x + wy * by_depth_y * r_y) ** 2 / (
            prior + wx * by_depth_x**2 + wy * by_depth_y**2
        )
        believed = 1 / (1 + error.clamp(min=0) / (outlier * NOISE) ** 2)
        wx, wy = believed * wx, believed * wy
        depth_information = prior + wx * by_depth_x**2 + wy * by_depth_y**2
        mixed = J_x * (wx * by_depth_x).unsqueeze(-1) + J_y * (wy * by_depth_y).unsqueeze(-1)
        r_mixed = wx * by_depth_x * r_x + wy * by_depth_y * r_y
        J = torch.cat([J_x, J_y, mixed], dim=-2)  # (B, 3 P, 6)
        weights = torch.cat([wx, wy, -1 / depth_information], dim=-1).unsqueeze(-1) / len(rays)
        weighted = (J * weights).transpose(-1, -2)
        right = weighted @ torch.cat([r_x, r_y, r_mixed], dim=-1).unsqueeze(-1)
        step = solve(weighted @ J + DAMPING * identity, right[..., 0]).clamp(-LARGEST_STEP, LARGEST_STEP)
        R, t = euler_to_rotation(step[..., :3]) @ R, t + step[..., 3:]
    return R, t


def solve(A: Tensor, b: Tensor) -> Tensor:
    """Solution of ``A x = b`` for symmetric positive definite ``A`` ``(B, n, n)``, by Gauss and Jordan."""
    n = A.shape[-1]
    system = torch.cat([A, b.unsqueeze(-1)], dim=-1)
    unit = torch.eye(n, device=A.device)
    for k in range(n):
        row = system[..., k : k + 1, :] / system[..., k : k + 1, k : k + 1]
        system = system - (system[..., :, k : k + 1] - unit[:, k : k + 1]) * row
    return system[..., -1]


def rotation_to_euler(R: Tensor) -> Tensor:
    """Intrinsic XYZ Euler angles ``(..., 3)`` of rotations ``R = Rx Ry Rz`` of less than a right angle."""
    x = torch.atan2(-R[..., 1, 2], R[..., 2, 2])
    y = torch.asin(R[..., 0, 2].clamp(-0.999, 0.999))
    z = torch.atan2(-R[..., 0, 1], R[..., 0, 0])
    return torch.stack([x, y, z], dim=-1)
