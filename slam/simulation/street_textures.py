"""Procedural textures of what stands in a street: the ground, buildings, plants, signs and cars."""

import numpy as np

from slam.simulation.texture import (
    Axis,
    Lengths,
    Octave,
    Shader,
    Texels,
    cell_hash,
    grained,
    mix,
    slabs,
)


def _asphalt(texels: Texels) -> Lengths:
    rgb = _junction(texels)
    half, dash, fraction, edged, lane = texels.parameters[:5, 0].tolist()
    lengthways = texels.u.stripes(2.0 * dash, 2.0 * dash * fraction)
    if lane > 0.0:
        inside = np.abs(texels.v.at) < half - 3.0
        paint = lengthways * inside * texels.v.stripes(lane, 0.14, 0.07)
    else:
        paint = lengthways * texels.v.band(-0.07, 0.07)
    if edged > 0.5:
        # beside parked cars, or beside the verge
        low, high = (2.15, 2.03) if half > 4.5 else (0.35, 0.23)
        paint += texels.v.on(np.abs(texels.v.at)).band(half - low, half - high)
    painted = np.flatnonzero(paint > 0.01)
    wear = np.clip(
        0.78 + texels.chosen(painted).fractal((0.9, 0.2, 0.5), (0.3, 0.1, 0.3)), 0.15, 1.0
    )
    rgb[:, painted] = mix(rgb[:, painted], texels.second[:, painted], paint[painted] * wear)
    return rgb


def _junction(texels: Texels) -> Lengths:
    grain = texels.fractal(
        (7.0, 2.2, 0.17), (2.0, 0.5, 0.22), (1.1, 0.17, 0.2), (0.35, 0.24, 0.2), (0.11, 0.07, 0.16)
    )
    repair = texels.fractal((5.0, 2.4, 1.0))  # repaired patches have sharp edges
    patch = np.clip((repair - 0.42) * 6.0, 0.0, 1.0) * 0.26
    line = np.abs(texels.fractal((2.6, 1.3, 1.0)) + 0.4 * grain - 0.05)
    crack = 0.3 * np.clip(1.0 - 14.0 * line, 0.0, 1.0)
    rough = 1.0 - texels.parameters[5, 0]
    return texels.first * (1.0 + rough * grain - rough * patch - rough * crack)


def _kerb(texels: Texels) -> Lengths:
    grain = texels.fractal((2.5, 2.5, 0.14), (0.5, 0.5, 0.16), (0.12, 0.12, 0.16))
    return mix(texels.first * (1.0 + grain), 0.6 * texels.second, texels.u.stripes(1.0, 0.03))


def _mottled(*octaves: Octave) -> Shader:
    """Two colours blended by noise."""
    return lambda texels: mix(
        texels.first, texels.second, np.clip(0.45 + texels.fractal(*octaves), -0.3, 1.2)
    )


def _wall(texels: Texels) -> Lengths:
    _, spacing, window, _, style, height = texels.parameters
    u, v = texels.u.at - 0.5 * (spacing - window), texels.v.at
    grain = texels.fractal(
        (3.1, 3.7, 0.18), (1.1, 1.2, 0.14), (0.35, 0.4, 0.14), (0.12, 0.12, 0.12)
    )
    row = np.where(style == 2.0, np.float32(0.24), np.float32(0.17))
    joints = texels.v.stripes(row, 0.18 * row) * (style > 0.0)
    brick = texels.u.on(u + 0.22 * np.floor(v / row)).stripes(0.44, 0.05) * (style == 1.0)
    fade = np.clip(row / texels.v.size - 1.0, 0.0, 1.0) * (style == 1.0)
    tone = 0.3 * fade * (cell_hash(u / 0.44 + 0.5 * np.floor(v / row), v / row, 2) - 0.5)
    foot = 0.25 * texels.v.band(-1.0, 0.5) + 0.12 * np.clip(1.5 - v, 0.0, 1.0)
    rgb = texels.first * (1.0 + grain + tone - foot - 0.22 * np.maximum(joints, brick))
    rgb = mix(rgb, 0.8 * texels.second, texels.v.band(height - 0.35, height - 0.05))
    glazed = np.flatnonzero((window > 0.0) & (v < height - 0.3))
    if len(glazed):
        rgb[:, glazed] = _windows(rgb[:, glazed], texels.chosen(glazed))
    return rgb


def _windows(rgb: Lengths, texels: Texels) -> Lengths:
    """Rows of framed windows, and doors on the ground floor, painted over a wall ``(3, N)``."""
    floor, spacing, window, tall = texels.parameters[:4]
    u, v = texels.u.at - 0.5 * (spacing - window), texels.v.at
    column, storey = np.floor((u + 0.5 * (spacing - window)) / spacing), np.floor(v / floor)
    cell = column + texels.u.shift, storey + texels.v.shift
    luck = cell_hash(*cell, 3)
    door = (storey == 0) & (luck > 0.8)
    blind = (luck < 0.1) & ~door
    low = np.where(door, np.float32(0.1), np.float32(0.85))
    high = np.where(door, np.float32(2.2), low + tall)
    x, y = texels.u.on(u - column * spacing), texels.v.on(v - storey * floor)

    def opening(border: float) -> Lengths:
        across = x.band(-border, window + border)
        return across * y.band(low - border, high + border)

    framed, pane = opening(0.11), opening(-0.03)
    # a cross of glazing bars, and panes that mirror a bright or a dark part of the street
    level = y.band(low + 0.62 * tall - 0.03, low + 0.62 * tall + 0.03) * ~door
    bars = np.maximum(x.band(0.5 * window - 0.035, 0.5 * window + 0.035), level)
    tone = cell_hash(*cell, 5)
    blotch = 0.1 * texels.fractal((0.9, 0.7, 1.0))
    sheen = np.clip(
        0.12 + 0.55 * tone * tone + 0.25 * (y.at - low) / (high - low) + blotch, 0.03, 0.9
    )
    glass = sheen * np.array([[0.75], [0.85], [0.95]], dtype=np.float32)
    inside = np.where(door, (0.3 + 0.5 * tone) * texels.second, glass)
    inside = mix(inside, 0.8 * texels.second, bars * (window > 1.0))
    rgb = mix(rgb, texels.second, framed * ~blind)
    return mix(rgb, inside, pane * ~blind)


def _roof(texels: Texels) -> Lengths:
    rows, tiles = texels.v.stripes(0.35, 0.09), texels.u.stripes(0.3, 0.05)
    grain = texels.fractal((4.0, 3.0, 0.25), (0.9, 0.8, 0.22), (0.3, 0.35, 0.22))
    return texels.first * (1.0 + grain - 0.3 * rows - 0.15 * tiles)


def _sign(texels: Texels) -> Lengths:
    half, kind = texels.parameters[:2]
    x, y = np.abs(texels.u.at - half), texels.v.at - half
    edge = np.where(kind == 0, np.hypot(x, y), np.maximum(x, np.abs(y))) / half
    rim = np.clip((edge - 0.72) * half / texels.size + 0.5, 0.0, 1.0)
    bar = texels.v.on(y).band(-0.14 * half, 0.16 * half) * texels.u.on(x).band(-1.0, 0.5 * half)
    figure = np.maximum(rim, bar)
    plain = mix(texels.second, texels.first, figure)
    return np.where(kind == 2, mix(texels.first, texels.second, figure), plain)


def _paint(texels: Texels) -> Lengths:
    seams = np.maximum(texels.u.stripes(1.05, 0.05, -0.2), texels.v.band(-0.1, 0.1))
    light = (
        1.0
        + 0.25 * np.clip(texels.v.at - 0.3, -0.4, 0.5)
        + texels.fractal((1.3, 0.3, 0.16), (0.3, 0.2, 0.1))
    )
    return mix(texels.first * light, texels.second, 0.7 * seams)


def _glass(texels: Texels) -> Lengths:
    pillars = np.maximum(texels.u.stripes(1.1, 0.14, 0.05), texels.v.band(-0.2, 0.05))
    sheen = np.clip(1.0 + 1.6 * texels.fractal((0.8, 0.35, 1.0), (0.3, 0.2, 0.5)), 0.3, 4.0)
    return mix(texels.first * sheen, texels.second, pillars)


def _tyre(texels: Texels) -> Lengths:
    radius = np.hypot(texels.u.at, texels.v.at)
    return mix(texels.first, texels.second, Axis(radius, texels.size, radius).band(-1.0, 0.19))


def _fence(texels: Texels) -> Lengths:
    gap, height = texels.parameters[:2]
    slats = texels.u.stripes(gap, 0.35 * gap)
    rails = 1.0 - texels.v.band(0.78 * height, 0.88 * height)
    grain = texels.fractal((1.7, 0.9, 0.25), (0.25, 0.8, 0.2))
    return mix(texels.first * (1.0 + grain), texels.second, slats * rails)


STREET_SHADERS: dict[str, Shader] = {
    "asphalt": _asphalt,
    "junction": _junction,
    "pavement": slabs(
        0.3, (4.0, 4.0, 0.2), (1.0, 1.0, 0.16), (0.25, 0.25, 0.2), (0.08, 0.08, 0.12)
    ),
    "kerb": _kerb,
    "grass": _mottled(
        (24.0, 24.0, 0.3), (8.0, 8.0, 0.35), (2.5, 2.5, 0.35), (0.7, 0.7, 0.4), (0.2, 0.2, 0.4)
    ),
    "gravel": _mottled((6.0, 6.0, 0.3), (1.2, 1.2, 0.3), (0.3, 0.3, 0.4), (0.1, 0.1, 0.3)),
    "wall": _wall,
    "roof": _roof,
    "bark": _mottled((0.12, 0.6, 0.5), (0.4, 1.5, 0.4)),
    "leaves": _mottled((1.6, 1.6, 0.4), (0.55, 0.55, 0.6), (0.2, 0.2, 0.5)),
    "metal": grained((0.5, 1.3, 0.25), (0.2, 0.4, 0.2)),
    "sign": _sign,
    "paint": _paint,
    "glass": _glass,
    "tyre": _tyre,
    "fence": _fence,
}
