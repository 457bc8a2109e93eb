"""Objects of a street: buildings, trees, hedges, fences, lamps, signs, cars and people."""

from collections.abc import Iterable, Sequence
from itertools import pairwise

import numpy as np

from slam.simulation.shapes import UP, Site, lattice


def building(site: Site, width: float, depth: float) -> None:
    """A house on the rectangle from the place to (width, depth), gabled or flat."""
    rng = site.rng
    floor, floors = rng.uniform(2.7, 3.4), rng.integers(1, 5)
    height = floors * floor + rng.uniform(0.4, 0.9)
    plaster = site.colour("house")
    window_width = rng.uniform(0.8, 1.6)
    spacing = window_width + rng.uniform(0.6, 1.9)
    trim = site.colour("window frame")
    style = rng.choice(3, p=[0.45, 0.35, 0.2])  # plaster, brick, boards
    look = (floor, spacing, window_width, rng.uniform(1.1, 1.7), style, height)
    wall = site.instance("wall", plaster, trim, look)
    roof = site.instance("roof", "roof")
    site.box((width, depth, height), wall, top=roof)
    if rng.random() < 0.65:
        _gable(site, (width, depth, height), wall, roof)
    if rng.random() < 0.4:  # a bay or porch in front
        w = rng.uniform(0.2, 0.4) * width
        x = rng.uniform(0.5, width - w - 0.5)
        top = rng.uniform(0.6, 1.0) * height if floors > 1 else 2.6
        site.box((w, 0.9, top), wall, (x, -0.9, 0), roof)
    if rng.random() < 0.5:  # a chimney
        x, y = rng.uniform(0.2, 0.8) * width, rng.uniform(0.3, 0.7) * depth
        stone = site.instance("wall", 0.8 * plaster, trim, (99.0, 99.0, 0.0, 0.0, 1.0, height))
        site.box((0.8, 0.8, 3.0), stone, (x, y, height))


def _gable(site: Site, size: tuple[float, float, float], wall: int, roof: int) -> None:
    """A saddle roof with eaves over a box, its ridge along the longer or the shorter side."""
    width, depth, height = size
    if site.rng.random() < 0.35:  # ridge across
        site, width, depth = site.moved(width, turn=np.pi / 2.0), depth, width
    rise = depth * site.rng.uniform(0.25, 0.5)
    eave = 0.4
    drop = eave * rise / (0.5 * depth)
    left = site.moved(-eave, -eave, height - drop).origin
    right = site.moved(-eave, depth + eave, height - drop).origin
    ridge = site.moved(-eave, 0.5 * depth, height + rise).origin
    along = (width + 2 * eave) * site.frame[0]
    site.quad(left, along, ridge - left, roof)
    site.quad(right, along, ridge - right, roof)
    for end in (0.0, width):
        a, b = (site.moved(end, across, height).origin for across in (0.0, depth))
        c = site.moved(end, 0.5 * depth, height + rise).origin
        uv = np.array([[[0.0, height], [depth, height]], [[0.5 * depth, height + rise]] * 2])
        site.patch(np.stack([[a, b], [c, c]]), uv, wall)


def tree(site: Site, size: float) -> None:
    """A trunk with a crown of lumpy balls, or a conifer of stacked cones."""
    rng, foot = site.rng, site.origin
    bark = site.instance("bark", "bark")
    green = site.colour("tree")
    leaves = site.instance("leaves", green, green * rng.uniform(0.35, 0.6))
    trunk = size * rng.uniform(0.28, 0.42)
    lean = np.array([*rng.normal(0.0, 0.04, 2), 1.0])
    site.tube(foot, foot + lean * (trunk + 0.25 * size), (0.035 * size, 0.02 * size), bark)
    if rng.random() < 0.2:
        for level in range(3):
            low = foot + lean * size * (0.15 + 0.27 * level)
            site.tube(low, low + UP * 0.42 * size, ((0.24 - 0.05 * level) * size, 0.02), leaves)
        return
    for _ in range(rng.integers(3, 6)):
        centre = foot + lean * (trunk + 0.28 * size) + rng.normal(0.0, [0.14, 0.14, 0.10]) * size
        site.ball(centre, np.array([1.0, 1.0, 0.85]) * size * rng.uniform(0.16, 0.26), leaves)


def hedge(site: Site, length: float) -> None:
    """A hedge, a fence or a low wall along the place's x axis."""
    kind, height = site.rng.random(), site.rng.uniform(0.8, 1.7)
    if kind < 0.5:
        look, thick = site.instance("leaves", "hedge", 0.5), 0.6
    elif kind < 0.8:
        wood = site.colour("fence")
        gap = site.rng.uniform(0.14, 0.3)
        look, thick = site.instance("fence", wood, 0.35, (gap, height)), 0.06
    else:
        plain = (99.0, 99.0, 0.0, 0.0, 1.0, height)  # without windows
        look = site.instance("wall", "garden wall", 1.0, plain)
        thick = 0.3
    site.box((length, thick, height), look)


def lamp(site: Site) -> None:
    """A street lamp whose arm reaches against the place's y axis."""
    steel = site.instance("metal", "street lamp")
    top = site.pole(site.rng.uniform(5.0, 8.0), (0.10, 0.06), steel)
    reach = 0.12 * UP - site.frame[1]
    site.tube(top, top + reach * site.rng.uniform(0.9, 1.8), (0.05, 0.09), steel)


def sign(site: Site) -> None:
    """A traffic sign on a post; its plate faces traffic that drives along the place's x axis."""
    steel = site.instance("metal", "sign post")
    height = site.rng.uniform(2.1, 2.7)
    site.pole(height + 0.3, (0.04, 0.04), steel)
    paint = site.colour("sign")
    half = site.rng.uniform(0.3, 0.45)
    kind = float(site.rng.integers(3))
    plate = site.instance("sign", paint, (0.92, 0.92, 0.90), (half, kind))
    site.box((0.02, 2 * half, 2 * half), plate, (-0.06, -half, height))


def fence(site: Site, length: float) -> None:
    """A railing, or posts and wires, along the place's x axis, which one sees through."""
    rng = site.rng
    steel = site.instance("metal", "fence bars")
    height, spacing = rng.uniform(0.6, 1.4), rng.choice([0.15, 0.3, 1.5, 2.5])
    _rails(
        site,
        length,
        max(spacing, length / 120),
        height,
        rng.uniform((0.015, 0.008), 0.05).tolist(),
        np.linspace(1.0, 0.25, rng.integers(1, 5)),
        steel,
    )


def barrier(site: Site, length: float, concrete: bool) -> None:
    """A wall of concrete, or a steel rail on posts, along the place's x axis."""
    look = site.instance("gravel" if concrete else "metal", "barrier", 0.8)
    if concrete:
        for along in np.arange(0.0, length - 3.9, 4.0).tolist():
            site.moved(along).box((4.0, 0.3, 0.9), look, (0, -0.15, 0))
    else:
        _rails(site, length, 4.0, 0.75, (0.06, 0.15), [0.8], look)


def _rails(
    site: Site,
    length: float,
    spacing: float,
    height: float,
    radii: Sequence[float],
    levels: Iterable[float],
    look: int,
) -> None:
    """Posts, and at some shares of their height bars, in pieces of about 4 m as the road bends.

    Args:
        site: where they begin.
        length: along its x axis.
        spacing: of posts.
        height: of posts.
        radii: of a post and of a bar.
        levels: of the bars.
        look: of all.
    """
    post, bar = radii
    for along in np.arange(0.0, length, spacing).tolist():
        site.moved(along).pole(height, (post, post), look)
    joints = np.linspace(0.0, length, int(length / 4.0) + 2).tolist()
    for level in levels:
        ends = [site.moved(along, up=level * height).origin for along in joints]
        for here, there in pairwise(ends):
            site.tube(here, there, (bar, bar), look)


def post(site: Site) -> None:
    """A bollard, a guide post or a mast."""
    steel = site.instance("metal", "post")
    radius = site.rng.uniform(0.03, 0.12)
    site.pole(site.rng.choice([1.0, 3.0, 7.0]), (radius, 0.8 * radius), steel)


def person(site: Site) -> None:
    """Legs, body and head of somebody who stands 10 cm above the place."""
    trousers, coat = (site.instance("metal", "clothes"), site.instance("metal", "clothes"))
    skin = site.instance("metal", "skin")
    size = site.rng.uniform(0.85, 1.08)
    foot = site.origin + 0.1 * UP
    side = 0.12 * np.array([*np.sin(site.rng.uniform(0, 7) + np.array([0, np.pi / 2])), 0.0])
    for leg in (foot + side, foot - side):
        site.tube(leg, foot + 0.5 * (leg - foot) + 0.85 * size * UP, (0.08, 0.11), trousers)
    site.tube(foot + 0.8 * size * UP, foot + 1.45 * size * UP, (0.17, 0.21), coat)
    site.ball(foot + 1.62 * size * UP, (0.11, 0.11, 0.15), skin)


def bonnet(site: Site, below: float, height_m: float) -> None:
    """The level bonnet before a camera, in its frame.

    Its far edge is seen at the slope ``below`` the axis.
    """
    far = min(site.rng.uniform(1.1, 2.0), 0.6 * height_m / max(below, 0.05))
    paint = site.instance("metal", "bonnet")
    site.box((2.2, 1.0, far - 0.25), paint, (-1.1, below * far, 0.25))


def car(site: Site) -> None:
    """A car centred on the place and pointing along its x axis: body, cabin and wheels."""
    rng = site.rng
    lacquer = site.colour("car")
    paint = site.instance("paint", lacquer, 0.4)
    glass = site.instance("glass", (0.10, 0.12, 0.14), 0.8 * lacquer)
    tyre = site.instance("tyre", (0.05, 0.05, 0.05), (0.5, 0.5, 0.5))
    length = rng.uniform(3.7, 4.7)
    half = rng.uniform(0.82, 0.92)
    van = rng.random() < 0.2
    waist = rng.uniform(0.82, 0.98)
    roof = rng.uniform(1.38, 1.6) + (0.45 if van else 0.0)
    site.box((length, 2 * half, waist - 0.25), paint, (-length / 2, -half, 0.25))
    hood = rng.uniform(0.10, 0.16) if van else rng.uniform(0.2, 0.3)
    low = (-0.48 * length, (0.5 - hood) * length)
    high = (low[0] + (0.1 if van else rng.uniform(0.2, 0.8)), low[1] - rng.uniform(0.5, 0.8))
    ring = []
    for (back, front), inset, z in ((low, 0.0, waist), (high, 0.14, roof)):
        y = half - inset
        ring.append([[back, -y, z], [front, -y, z], [front, y, z], [back, y, z], [back, -y, z]])
    points = np.array(ring) @ site.frame[:3] + site.origin
    corner = np.cumsum([0.0, low[1] - low[0], 2 * half, low[1] - low[0], 2 * half])
    site.patch(points, lattice(corner, (0.0, roof - waist)), glass)
    site.quad(points[1, 0], points[1, 1] - points[1, 0], points[1, 3] - points[1, 0], paint)
    angle = np.linspace(0.0, 2.0 * np.pi, 11)
    rim = np.stack([0.32 * np.cos(angle), np.zeros(11), 0.32 * np.sin(angle)], axis=1)
    uv = np.stack([np.zeros((11, 2)), rim[:, ::2]])
    for x in (-0.3 * length, 0.32 * length):
        for side in (-1.0, 1.0):
            hub = np.array([x, side * (half + 0.015), 0.32])
            disc = np.stack([np.broadcast_to(hub, rim.shape), hub + rim])
            site.patch(disc @ site.frame[:3] + site.origin, uv, tyre)
