"""What stands in a street: houses, trees, poles and cars, each different, as patches of a ``Soup``."""

from __future__ import annotations

import colorsys

import numpy as np

from slam.sequences.street.geometry import FloatArray, Material, Soup

KERB_HEIGHT = 0.13
WALL_HUES = np.array([0.02, 0.05, 0.08, 0.09, 0.11, 0.13, 0.58, 0.60])
UP = np.array([0.0, 0.0, 1.0])


def hsv(hue: float, saturation: float, value: float) -> FloatArray:
    """RGB ``(3,)`` of hue (any number, one turn is 1), saturation and value (clipped to [0, 1])."""
    clipped = (min(max(saturation, 0.0), 1.0), min(max(value, 0.0), 1.0))
    return np.array(colorsys.hsv_to_rgb(hue % 1.0, *clipped))


def fine_quad(
    soup: Soup, corner: FloatArray, along: FloatArray, up: FloatArray, instance: int, step: float = 6.0
) -> None:
    """A parallelogram in pieces of about ``step`` metres, so that it bends with the street."""
    width, height = float(np.linalg.norm(along)), float(np.linalg.norm(up))
    a = np.linspace(0, 1, max(1, int(width / step)) + 1)
    b = np.linspace(0, 1, max(1, int(height / step)) + 1)
    points = corner + a[None, :, None] * along + b[:, None, None] * up
    uv = np.stack(np.broadcast_arrays(a[None] * width, b[:, None] * height), -1)
    soup.patch(points, uv, instance)


def frustum(
    soup: Soup,
    centre: FloatArray,
    yaw: float,
    size: tuple[float, float, float],
    taper: tuple[float, float],
    side: int,
    top: int,
    bottom_z: float,
) -> None:
    """A box of length, width, height whose top is shorter by ``taper`` at each end, without a floor."""
    length, width, height = size
    ex, ey = np.array([np.cos(yaw), np.sin(yaw), 0.0]), np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    origin = np.array([centre[0], centre[1], bottom_z])
    corners = ((-1, -1), (1, -1), (1, 1), (-1, 1))
    low = [origin + sx * ex * length / 2 + sy * ey * width / 2 for sx, sy in corners]
    high = [
        origin + UP * height + sx * ex * (length / 2 - taper[0]) + sy * ey * (width / 2 - taper[1])
        for sx, sy in corners
    ]
    for k in range(4):
        a, b, c, d = low[k], low[(k + 1) % 4], high[k], high[(k + 1) % 4]
        across = float(np.linalg.norm(b - a))
        uv = np.array([[[0, 0], [across, 0]], [[0, height], [across, height]]])
        soup.patch(np.array([[a, b], [c, d]]), uv, side)
    uv = np.array([[[0, 0], [length, 0]], [[0, width], [length, width]]])
    soup.patch(np.array([[high[0], high[1]], [high[3], high[2]]]), uv, top)


def building(
    soup: Soup,
    rng: np.random.Generator,
    corner: FloatArray,
    along: FloatArray,
    inward: FloatArray,
    size: tuple[float, float, float],
    palette: float,
) -> None:
    """A house with its own colours, floors, windows and roof.

    Args:
        soup: receives it.
        rng: decides its looks.
        corner: of the front, ``(3,)``; its z is ignored.
        along: unit vector along the front.
        inward: unit vector from the front to the back.
        size: width, depth and height of the walls, metres.
        palette: shifts all hues of a town a little, in [0, 1].
    """
    width, depth, height = size
    hue = float(rng.choice(WALL_HUES)) + 0.12 * (palette - 0.5) + rng.normal(0, 0.015)
    wall = hsv(hue, rng.uniform(0.04, 0.4), rng.uniform(0.42, 0.95))
    trim = hsv(hue + rng.normal(0, 0.1), 0.15, rng.uniform(0.25, 0.95))
    window = rng.uniform(0.8, 1.6)
    looks = (
        rng.uniform(2.7, 3.6),  # floor height
        window + rng.uniform(0.8, 2.2),  # distance between windows
        window,
        rng.uniform(1.1, 1.8),  # window height
        rng.uniform(0, 1),  # bricks above 0.5
        rng.uniform(0, 1),  # which windows are lit or curtained
    )
    walls = soup.instance(Material.WALL, wall, trim, looks)
    roof = soup.instance(Material.ROOF, hsv(rng.uniform(0, 0.08), rng.uniform(0.1, 0.6), rng.uniform(0.25, 0.6)))
    base = np.array([corner[0], corner[1], 0.0])
    ground = [base, base + along * width, base + along * width + inward * depth, base + inward * depth]
    up = UP * (height + KERB_HEIGHT)
    for k in range(4):
        soup.quad(ground[k], ground[(k + 1) % 4] - ground[k], up, walls)
    eaves = [point + up for point in ground]
    if rng.random() < 0.4:
        soup.quad(eaves[0], eaves[1] - eaves[0], eaves[3] - eaves[0], roof)
        return
    rise = rng.uniform(1.2, 3.0)
    ridge = [(eaves[0] + eaves[3]) / 2 + UP * rise, (eaves[1] + eaves[2]) / 2 + UP * rise]
    overhang = 0.4 * inward
    soup.quad(eaves[0] - overhang, eaves[1] - eaves[0], ridge[0] - eaves[0] + overhang, roof)
    soup.quad(eaves[2] + overhang, eaves[3] - eaves[2], ridge[1] - eaves[2] - overhang, roof)
    for front, back, top in ((eaves[0], eaves[3], ridge[0]), (eaves[1], eaves[2], ridge[1])):
        uv = np.array([[[0, 0], [depth, 0]], [[depth / 2, rise], [depth / 2, rise]]])
        soup.patch(np.array([[front, back], [top, top]]), uv, walls)


def tree(soup: Soup, rng: np.random.Generator, place: FloatArray, ground_z: float) -> None:
    """A trunk and one to three leafy blobs."""
    trunk, radius = rng.uniform(1.8, 3.2), rng.uniform(0.1, 0.22)
    bark = soup.instance(Material.BARK, hsv(0.07, rng.uniform(0.2, 0.5), rng.uniform(0.2, 0.45)))
    _tube(soup, place, radius, ground_z, trunk + 0.8, bark)
    green = hsv(rng.uniform(0.2, 0.38), rng.uniform(0.3, 0.7), rng.uniform(0.25, 0.6))
    leaves = soup.instance(Material.LEAVES, green)
    size = rng.uniform(1.2, 2.3)
    for _ in range(int(rng.integers(1, 4))):
        centre = np.array([place[0], place[1], ground_z + trunk + size * 0.7]) + rng.normal(0, 0.45, 3)
        _blob(soup, rng, centre, size * rng.uniform(0.65, 1.0), leaves)


def pole(soup: Soup, rng: np.random.Generator, place: FloatArray, ground_z: float) -> None:
    """A lamp post, or a traffic sign facing anywhere."""
    metal = soup.instance(Material.METAL, hsv(0.6, 0.05, rng.uniform(0.2, 0.7)))
    signed = rng.random() < 0.5
    height = rng.uniform(2.4, 3.0) if signed else rng.uniform(4.5, 7.0)
    _tube(soup, place, 0.06, ground_z, height, metal)
    if signed:
        rim = hsv(float(rng.choice([0.0, 0.6, 0.13])), 0.9, 0.8)
        side, yaw = rng.uniform(0.5, 0.9), rng.uniform(0, 2 * np.pi)
        face = soup.instance(Material.SIGN, rim, np.array([0.95, 0.95, 0.95]), (side,))
        across = np.array([np.cos(yaw), np.sin(yaw), 0.0]) * side
        corner = np.array([place[0], place[1], ground_z + height - side]) - across / 2 + 0.07 * np.cross(across, UP)
        soup.quad(corner, across, UP * side, face)


def car(soup: Soup, rng: np.random.Generator, place: FloatArray, yaw: float, ground_z: float = 0.0) -> None:
    """Body, cabin and wheels in their own colour and size."""
    paint = soup.instance(Material.PAINT, hsv(rng.uniform(0, 1), rng.uniform(0, 0.9), rng.uniform(0.15, 0.95)))
    glass = soup.instance(Material.GLASS, np.array([0.1, 0.12, 0.15]))
    tyre = soup.instance(Material.TYRE, np.array([0.06, 0.06, 0.06]))
    length, width, body = rng.uniform(3.7, 4.8), rng.uniform(1.6, 1.85), rng.uniform(0.55, 0.7)
    frustum(soup, place, yaw, (length, width, body), (0.1, 0.04), paint, paint, ground_z + 0.28)
    forward = np.array([np.cos(yaw), np.sin(yaw)])
    cabin = (length * rng.uniform(0.55, 0.72), width * 0.95, rng.uniform(0.5, 0.65))
    centre = place[:2] + forward * rng.uniform(-0.4, 0.1)
    frustum(soup, centre, yaw, cabin, (rng.uniform(0.3, 0.6), 0.12), glass, paint, ground_z + 0.28 + body)
    left = np.array([-forward[1], forward[0]])
    for along in (-0.31, 0.31):
        for across in (-0.46, 0.46):
            wheel = place[:2] + along * length * forward + across * width * left
            frustum(soup, wheel, yaw, (0.62, 0.2, 0.62), (0.08, 0.0), tyre, tyre, ground_z)


def _tube(soup: Soup, place: FloatArray, radius: float, bottom: float, height: float, instance: int) -> None:
    angle = np.linspace(0, 2 * np.pi, 7)
    ring = np.stack([place[0] + radius * np.cos(angle), place[1] + radius * np.sin(angle)], -1)
    points = np.stack([np.column_stack([ring, np.full(7, z)]) for z in (bottom, bottom + height)])
    uv = np.stack([np.column_stack([angle * radius, np.full(7, z)]) for z in (0.0, height)])
    soup.patch(points, uv, instance)


def _blob(soup: Soup, rng: np.random.Generator, centre: FloatArray, radius: float, instance: int) -> None:
    """A lumpy ball."""
    turn, rise = np.linspace(0, 2 * np.pi, 9), np.linspace(-0.48 * np.pi, 0.48 * np.pi, 6)
    r = radius * (1 + rng.uniform(-0.22, 0.22, (6, 9)))
    r[:, -1] = r[:, 0]
    flat, height = np.cos(rise)[:, None], np.sin(rise)[:, None]
    points = np.stack([r * flat * np.cos(turn), r * flat * np.sin(turn), r * height], -1) + centre
    uv = np.stack(np.broadcast_arrays(turn[None] * radius, rise[:, None] * radius), -1)
    soup.patch(points, uv, instance)
