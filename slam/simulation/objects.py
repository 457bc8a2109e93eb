"""Objects of a street: buildings, trees, hedges, fences, lamps, signs, cars and people."""

from itertools import pairwise

import numpy as np

from slam.simulation.geometry import FloatArray, Material, Soup
from slam.simulation.shapes import UP, ball, box, colour, frame_at, tube


def building(
    soup: Soup, rng: np.random.Generator, frame: FloatArray, width: float, depth: float
) -> None:
    """A house on the rectangle from the frame's origin to (width, depth), gabled or flat."""
    floor, floors = float(rng.uniform(2.7, 3.4)), int(rng.integers(1, 5))
    height = floors * floor + float(rng.uniform(0.4, 0.9))
    plaster = colour(
        rng, (0.72, 0.66, 0.55), (0.62, 0.36, 0.27), (0.82, 0.80, 0.76), (0.66, 0.58, 0.42),
        (0.52, 0.52, 0.54), (0.75, 0.55, 0.42), (0.55, 0.60, 0.62), (0.48, 0.30, 0.25),
    )  # fmt: skip
    window_width = float(rng.uniform(0.8, 1.6))
    spacing = window_width + float(rng.uniform(0.6, 1.9))
    trim = colour(rng, (0.85, 0.85, 0.82), (0.30, 0.24, 0.20), (0.45, 0.50, 0.45), spread=0.08)
    style = float(rng.choice([0.0, 1.0, 2.0], p=[0.45, 0.35, 0.2]))  # plaster, brick, boards
    look = (floor, spacing, window_width, float(rng.uniform(1.1, 1.7)), style, height)
    wall = soup.instance(Material.WALL, plaster, trim, look)
    tiles = colour(
        rng, (0.45, 0.22, 0.16), (0.30, 0.28, 0.28), (0.50, 0.33, 0.24), (0.24, 0.22, 0.24)
    )
    roof = soup.instance(Material.ROOF, tiles)
    box(soup, frame, np.zeros(3), np.array([width, depth, height]), wall, top=roof)
    if rng.random() < 0.65:
        _gable(soup, rng, frame, (width, depth, height), wall, roof)
    if rng.random() < 0.4:  # a bay or porch in front
        w = float(rng.uniform(0.2, 0.4)) * width
        x = float(rng.uniform(0.5, width - w - 0.5))
        top = float(rng.uniform(0.6, 1.0)) * height if floors > 1 else 2.6
        box(soup, frame, np.array([x, -0.9, 0.0]), np.array([x + w, 0.0, top]), wall, top=roof)
    if rng.random() < 0.5:  # a chimney
        x, y = rng.uniform(0.2, 0.8) * width, rng.uniform(0.3, 0.7) * depth
        stone = soup.instance(
            Material.WALL, 0.8 * plaster, trim, (99.0, 99.0, 0.0, 0.0, 1.0, height)
        )
        low = np.array([x, y, height])
        box(soup, frame, low, low + np.array([0.8, 0.8, 3.0]), stone)


def _gable(
    soup: Soup,
    rng: np.random.Generator,
    frame: FloatArray,
    size: tuple[float, float, float],
    wall: int,
    roof: int,
) -> None:
    """A saddle roof with eaves over a box, its ridge along the longer or the shorter side."""
    width, depth, height = size
    axis_x, axis_y, axis_z, origin = frame
    if rng.random() < 0.35:  # ridge across
        axis_x, axis_y, origin = axis_y, -axis_x, origin + width * axis_x
        width, depth = depth, width
    rise = depth * float(rng.uniform(0.25, 0.5))
    eave = 0.4
    drop = eave * rise / (0.5 * depth)
    left = origin - eave * axis_x - eave * axis_y + (height - drop) * axis_z
    right = left + (depth + 2 * eave) * axis_y
    ridge = origin - eave * axis_x + 0.5 * depth * axis_y + (height + rise) * axis_z
    along = (width + 2 * eave) * axis_x
    soup.quad(left, along, ridge - left, roof)
    soup.quad(right, along, ridge - right, roof)
    for end in (0.0, width):
        a = origin + end * axis_x + height * axis_z
        b, c = a + depth * axis_y, a + 0.5 * depth * axis_y + rise * axis_z
        uv = np.array([[[0.0, height], [depth, height]], [[0.5 * depth, height + rise]] * 2])
        soup.patch(np.stack([[a, b], [c, c]]), uv, wall)


def tree(
    soup: Soup, rng: np.random.Generator, x: float, y: float, size: float, z: float = 0.0
) -> None:
    """A trunk with a crown of lumpy balls, or a conifer of stacked cones."""
    bark = soup.instance(
        Material.BARK, colour(rng, (0.32, 0.25, 0.19), (0.42, 0.38, 0.33), spread=0.04)
    )
    green = colour(
        rng,
        (0.20, 0.33, 0.12),
        (0.30, 0.40, 0.15),
        (0.15, 0.27, 0.14),
        (0.42, 0.40, 0.16),
        spread=0.03,
    )
    leaves = soup.instance(Material.LEAVES, green, green * rng.uniform(0.35, 0.6))
    foot = np.array([x, y, z])
    trunk = size * float(rng.uniform(0.28, 0.42))
    lean = np.array([*rng.normal(0.0, 0.04, 2), 1.0])
    tube(soup, foot, foot + lean * (trunk + 0.25 * size), (0.035 * size, 0.02 * size), bark)
    if rng.random() < 0.2:
        for level in range(3):
            low = foot + lean * size * (0.15 + 0.27 * level)
            tube(soup, low, low + UP * 0.42 * size, ((0.24 - 0.05 * level) * size, 0.02), leaves)
        return
    for _ in range(int(rng.integers(3, 6))):
        centre = foot + lean * (trunk + 0.28 * size) + rng.normal(0.0, [0.14, 0.14, 0.10]) * size
        ball(soup, rng, centre, np.array([1.0, 1.0, 0.85]) * size * rng.uniform(0.16, 0.26), leaves)


def hedge(soup: Soup, rng: np.random.Generator, frame: FloatArray, length: float) -> None:
    """A hedge, a fence or a low wall along the frame's x axis."""
    kind, height = rng.random(), float(rng.uniform(0.8, 1.7))
    if kind < 0.5:
        green = colour(rng, (0.17, 0.30, 0.12), (0.25, 0.34, 0.14), spread=0.03)
        look, thick = soup.instance(Material.LEAVES, green, 0.5 * green), 0.6
    elif kind < 0.8:
        wood = colour(rng, (0.45, 0.33, 0.22), (0.75, 0.75, 0.72), (0.25, 0.27, 0.26))
        gap = float(rng.uniform(0.14, 0.3))
        look, thick = soup.instance(Material.FENCE, wood, 0.35 * wood, (gap, height)), 0.06
    else:
        stone = colour(rng, (0.58, 0.55, 0.50), (0.52, 0.38, 0.30))
        look = soup.instance(Material.WALL, stone, stone, (99.0, 99.0, 0.0, 0.0, 1.0, height))
        thick = 0.3
    box(soup, frame, np.zeros(3), np.array([length, thick, height]), look)


def lamp(soup: Soup, rng: np.random.Generator, x: float, y: float, towards: FloatArray) -> None:
    """A street lamp whose arm reaches ``towards`` the road, a plan direction ``(2,)``."""
    steel = soup.instance(
        Material.METAL, colour(rng, (0.42, 0.44, 0.45), (0.20, 0.26, 0.22), spread=0.04)
    )
    foot, height = np.array([x, y, 0.0]), float(rng.uniform(5.0, 8.0))
    tube(soup, foot, foot + height * UP, (0.10, 0.06), steel)
    reach = np.array([towards[0], towards[1], 0.12])
    tube(
        soup,
        foot + height * UP,
        foot + height * UP + reach * rng.uniform(0.9, 1.8),
        (0.05, 0.09),
        steel,
    )


def sign(soup: Soup, rng: np.random.Generator, x: float, y: float, facing: float) -> None:
    """A traffic sign on a post; its plate faces traffic that drives along the angle ``facing``."""
    steel = soup.instance(Material.METAL, colour(rng, (0.55, 0.56, 0.57), spread=0.03))
    foot, height = np.array([x, y, 0.0]), float(rng.uniform(2.1, 2.7))
    tube(soup, foot, foot + (height + 0.3) * UP, (0.04, 0.04), steel)
    paint = colour(
        rng, (0.70, 0.08, 0.08), (0.08, 0.20, 0.60), (0.85, 0.65, 0.08), (0.10, 0.40, 0.20)
    )
    half = float(rng.uniform(0.3, 0.45))
    kind = float(rng.integers(3))
    plate = soup.instance(Material.SIGN, paint, np.array([0.92, 0.92, 0.90]), (half, kind))
    frame = frame_at(x, y, facing - np.pi / 2.0, height)
    frame[3] -= 0.06 * frame[1] + half * frame[0]
    box(soup, frame, np.zeros(3), np.array([2 * half, 0.02, 2 * half]), plate)


def railing(soup: Soup, rng: np.random.Generator, frame: FloatArray, length: float) -> None:
    """Posts and bars along the frame's x axis, which one sees through."""
    tone = colour(
        rng, (0.55, 0.56, 0.57), (0.18, 0.20, 0.20), (0.72, 0.72, 0.70), (0.42, 0.30, 0.20)
    )
    steel = soup.instance(Material.METAL, tone)
    height, spacing = float(rng.uniform(0.6, 1.3)), float(rng.choice([0.15, 0.3, 1.5, 2.5]))
    radius = float(rng.uniform(0.015, 0.05))
    posts = np.arange(0.0, length, max(spacing, length / 120))
    for along in posts:
        foot = frame[3] + along * frame[0]
        tube(soup, foot, foot + height * UP, (radius, radius), steel)
    for level in np.linspace(1.0, 0.25, int(rng.integers(1, 4))):
        bar = frame[3] + level * height * UP
        tube(soup, bar, bar + posts[-1] * frame[0] + 1e-3 * frame[0], (radius, radius), steel)


def wire_fence(soup: Soup, rng: np.random.Generator, frame: FloatArray, length: float) -> None:
    """Wooden posts and the wires between them along the frame's x axis."""
    wood = soup.instance(
        Material.BARK, colour(rng, (0.42, 0.36, 0.29), (0.55, 0.52, 0.48), spread=0.03)
    )
    wire = soup.instance(Material.METAL, colour(rng, (0.5, 0.5, 0.5), spread=0.03))
    height = float(rng.uniform(0.9, 1.4))
    posts = np.arange(0.0, length, float(rng.uniform(2.0, 4.0)))
    for along in posts:
        foot = frame[3] + along * frame[0]
        tube(soup, foot - 0.2 * UP, foot + height * UP, (0.05, 0.045), wood)
    for level in np.linspace(0.95, 0.3, int(rng.integers(2, 5))):
        for here, there in pairwise(posts):
            up = frame[3] + level * height * UP
            tube(soup, up + here * frame[0], up + there * frame[0], (0.008, 0.008), wire)


def barrier(
    soup: Soup, rng: np.random.Generator, frame: FloatArray, length: float, concrete: bool
) -> None:
    """A wall of concrete, or a steel rail on posts, along the frame's x axis in pieces of 4 m."""
    grey = colour(rng, (0.62, 0.61, 0.58), (0.5, 0.5, 0.5), spread=0.04)
    look = soup.instance(Material.GRAVEL if concrete else Material.METAL, grey, 0.8 * grey)
    for along in np.arange(0.0, length - 3.9, 4.0):
        place = frame.copy()
        place[3] += along * frame[0]
        if concrete:
            box(soup, place, np.array([0.0, -0.3, 0.0]), np.array([4.0, 0.3, 0.35]), look)
            box(soup, place, np.array([0.0, -0.12, 0.35]), np.array([4.0, 0.12, 0.9]), look)
        else:
            tube(soup, place[3], place[3] + 0.75 * UP, (0.06, 0.06), look)
            box(soup, place, np.array([0.0, -0.05, 0.45]), np.array([4.0, 0.05, 0.76]), look)


def post(soup: Soup, rng: np.random.Generator, x: float, y: float) -> None:
    """A bollard, a guide post or a mast."""
    steel = soup.instance(
        Material.METAL, colour(rng, (0.85, 0.85, 0.82), (0.30, 0.28, 0.26), (0.50, 0.50, 0.52))
    )
    foot, radius = np.array([x, y, 0.0]), float(rng.uniform(0.03, 0.12))
    tube(soup, foot, foot + float(rng.choice([1.0, 3.0, 7.0])) * UP, (radius, 0.8 * radius), steel)


def person(soup: Soup, rng: np.random.Generator, x: float, y: float) -> None:
    """Legs, body and head of somebody who stands."""
    clothes = [
        colour(rng, (0.2, 0.2, 0.25), (0.6, 0.2, 0.2), (0.7, 0.7, 0.68), (0.2, 0.3, 0.55))
        for _ in range(2)
    ]
    trousers, coat = (soup.instance(Material.METAL, shade) for shade in clothes)
    skin = soup.instance(
        Material.METAL, colour(rng, (0.75, 0.58, 0.47), (0.45, 0.32, 0.25), spread=0.03)
    )
    size = float(rng.uniform(0.85, 1.08))
    foot = np.array([x, y, 0.1])
    side = 0.12 * np.array([*np.sin(rng.uniform(0, 7) + np.array([0, np.pi / 2])), 0.0])
    for leg in (foot + side, foot - side):
        tube(soup, leg, foot + 0.5 * (leg - foot) + 0.85 * size * UP, (0.08, 0.11), trousers)
    tube(soup, foot + 0.8 * size * UP, foot + 1.45 * size * UP, (0.17, 0.21), coat)
    ball(soup, rng, foot + 1.62 * size * UP, np.array([0.11, 0.11, 0.15]), skin)


def bonnet(soup: Soup, rng: np.random.Generator, below: float, height_m: float) -> None:
    """The bonnet before a camera, in its frame.

    Its far edge is seen at the slope ``below`` the axis.
    """
    far = float(min(rng.uniform(1.1, 2.0), 0.6 * height_m / max(below, 0.05)))
    x, z = np.meshgrid(np.linspace(-1.1, 1.1, 15), np.linspace(0.25, far, 8))
    y = (
        below * far
        + 0.12 * (far - z) ** 2
        + 0.10 * x**2
        + 0.25 * np.clip(np.abs(x) - 0.7, 0.0, None)
    )
    lacquer = colour(
        rng,
        (0.7, 0.7, 0.72),
        (0.08, 0.08, 0.09),
        (0.35, 0.36, 0.38),
        (0.5, 0.08, 0.08),
        (0.1, 0.16, 0.4),
    )
    paint = soup.instance(Material.METAL, lacquer)
    soup.patch(np.stack([x, y, z], axis=2), np.stack([x, z], axis=2), paint)


def car(soup: Soup, rng: np.random.Generator, frame: FloatArray) -> None:
    """A car centred on the frame's origin and pointing along its x axis: body, cabin and wheels."""
    lacquer = colour(
        rng, (0.75, 0.76, 0.78), (0.10, 0.10, 0.11), (0.45, 0.46, 0.48), (0.55, 0.08, 0.08),
        (0.10, 0.18, 0.42), (0.85, 0.85, 0.84), (0.20, 0.32, 0.22), (0.70, 0.55, 0.15),
    )  # fmt: skip
    paint = soup.instance(Material.PAINT, lacquer, 0.4 * lacquer, (1.0,))
    glass = soup.instance(Material.GLASS, np.array([0.10, 0.12, 0.14]), 0.8 * lacquer, (1.0,))
    tyre = soup.instance(
        Material.TYRE, np.array([0.05, 0.05, 0.05]), np.array([0.5, 0.5, 0.5]), (0.32,)
    )
    length = float(rng.uniform(3.7, 4.7))
    half = float(rng.uniform(0.82, 0.92))
    van = rng.random() < 0.2
    waist = float(rng.uniform(0.82, 0.98))
    roof = float(rng.uniform(1.38, 1.6)) + (0.45 if van else 0.0)
    box(
        soup,
        frame,
        np.array([-length / 2, -half, 0.25]),
        np.array([length / 2, half, waist]),
        paint,
    )
    hood = float(rng.uniform(0.10, 0.16) if van else rng.uniform(0.2, 0.3))
    low = (-0.48 * length, (0.5 - hood) * length)
    high = (low[0] + (0.1 if van else rng.uniform(0.2, 0.8)), low[1] - rng.uniform(0.5, 0.8))
    ring = []
    for (back, front), inset, z in ((low, 0.0, waist), (high, 0.14, roof)):
        y = half - inset
        ring.append([[back, -y, z], [front, -y, z], [front, y, z], [back, y, z], [back, -y, z]])
    points = np.array(ring) @ frame[:3] + frame[3]
    corner = np.cumsum([0.0, low[1] - low[0], 2 * half, low[1] - low[0], 2 * half])
    uv = np.stack([np.stack([corner, corner]), np.array([[0.0] * 5, [roof - waist] * 5])], axis=2)
    soup.patch(points, uv, glass)
    soup.quad(points[1, 0], points[1, 1] - points[1, 0], points[1, 3] - points[1, 0], paint)
    angle = np.linspace(0.0, 2.0 * np.pi, 11)
    for x in (-0.3 * length, 0.32 * length):
        for side in (-1.0, 1.0):
            rim = np.stack([0.32 * np.cos(angle), np.zeros(11), 0.32 * np.sin(angle)], axis=1)
            hub = np.array([x, side * (half + 0.015), 0.32])
            disc = np.stack([np.broadcast_to(hub, rim.shape), hub + rim]) @ frame[:3] + frame[3]
            uv = np.stack([np.zeros((11, 2)), rim[:, ::2]])
            soup.patch(disc, uv, tyre)
