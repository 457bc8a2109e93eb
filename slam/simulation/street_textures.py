"""Procedural textures of what stands in a street: the ground, buildings, plants, signs and cars."""

from dataclasses import fields

import numpy as np
from numpy.typing import NDArray

from slam.simulation.geometry import Float32Array, Material
from slam.simulation.texture import (
    Shader,
    Texels,
    band,
    cell_hash,
    fractal,
    grained,
    mix,
    pixel_size,
    stripes,
)


def _asphalt(texels: Texels, colours: Float32Array, parameters: Float32Array) -> Float32Array:
    rgb = _junction(texels, colours, parameters)
    half = parameters[0, 0]
    dash = parameters[1, 0]
    fraction = parameters[2, 0]
    lengthways = stripes(texels.u, texels.u_size, float(2.0 * dash), float(2.0 * dash * fraction))
    lane = float(parameters[4, 0])
    if lane > 0.0:
        inside = np.abs(texels.v) < half - 3.0
        paint = lengthways * inside * stripes(texels.v + 0.07, texels.v_size, lane, 0.14)
    else:
        paint = lengthways * band(texels.v, texels.v_size, -0.07, 0.07)
    if parameters[3, 0] > 0.5:
        # beside parked cars, or beside the verge
        low, high = (2.15, 2.03) if half > 4.5 else (0.35, 0.23)
        paint += band(np.abs(texels.v), texels.v_size, half - low, half - high)
    painted = np.flatnonzero(paint > 0.01)
    wear = np.clip(
        0.78 + fractal(_take(texels, painted), (0.9, 0.2, 0.5), (0.3, 0.1, 0.3)), 0.15, 1.0
    )
    rgb[:, painted] = mix(rgb[:, painted], colours[1][:, painted], paint[painted] * wear)
    return rgb


def _junction(texels: Texels, colours: Float32Array, parameters: Float32Array) -> Float32Array:
    grain = fractal(
        texels,
        (7.0, 2.2, 0.17),
        (2.0, 0.5, 0.22),
        (1.1, 0.17, 0.2),
        (0.35, 0.24, 0.2),
        (0.11, 0.07, 0.16),
    )
    repair = fractal(texels, (5.0, 2.4, 1.0))  # repaired patches have sharp edges
    patch = np.clip((repair - 0.42) * 6.0, 0.0, 1.0) * 0.26
    crack = 0.3 * np.clip(
        1.0 - 14.0 * np.abs(fractal(texels, (2.6, 1.3, 1.0)) + 0.4 * grain - 0.05), 0.0, 1.0
    )
    rough = 1.0 - parameters[5, 0]
    return np.asarray(colours[0] * (1.0 + rough * grain - rough * patch - rough * crack))


def _pavement(texels: Texels, colours: Float32Array, parameters: Float32Array) -> Float32Array:
    slab = float(parameters[0, 0])
    joints = np.maximum(
        stripes(texels.u, texels.u_size, slab, 0.035), stripes(texels.v, texels.v_size, slab, 0.035)
    )
    near = np.clip(slab / pixel_size(texels) / 2.0 - 0.5, 0.0, 1.0)
    tone = (cell_hash(texels.u / slab, texels.v / slab, 1) - 0.5) * near * 0.3
    grain = fractal(
        texels, (4.0, 4.0, 0.2), (1.0, 1.0, 0.16), (0.25, 0.25, 0.2), (0.08, 0.08, 0.12)
    )
    return mix(colours[0] * (1.0 + grain + tone), 0.6 * colours[1], joints)


def _kerb(texels: Texels, colours: Float32Array, parameters: Float32Array) -> Float32Array:
    joints = stripes(texels.u, texels.u_size, 1.0, 0.03)
    grain = fractal(texels, (2.5, 2.5, 0.14), (0.5, 0.5, 0.16), (0.12, 0.12, 0.16))
    return mix(colours[0] * (1.0 + grain), 0.6 * colours[1], joints)


def _mottled(*octaves: tuple[float, float, float]) -> Shader:
    """Two colours blended by noise."""
    return lambda texels, colours, _: mix(
        colours[0], colours[1], np.clip(0.45 + fractal(texels, *octaves), -0.3, 1.2)
    )


def _wall(texels: Texels, colours: Float32Array, parameters: Float32Array) -> Float32Array:
    _, spacing, window, _, style, height = parameters
    u, v = texels.u - 0.5 * (spacing - window), texels.v
    grain = fractal(
        texels, (3.1, 3.7, 0.18), (1.1, 1.2, 0.14), (0.35, 0.4, 0.14), (0.12, 0.12, 0.12)
    )
    row = np.where(style == 2.0, np.float32(0.24), np.float32(0.17))
    joints = stripes(v, texels.v_size, row, 0.18 * row) * (style > 0.0)
    brick = stripes(u + 0.22 * np.floor(v / row), texels.u_size, 0.44, 0.05) * (style == 1.0)
    fade = np.clip(row / texels.v_size - 1.0, 0.0, 1.0) * (style == 1.0)
    tone = 0.3 * fade * (cell_hash(u / 0.44 + 0.5 * np.floor(v / row), v / row, 2) - 0.5)
    foot = 0.25 * band(v, texels.v_size, -1.0, 0.5) + 0.12 * np.clip(1.5 - v, 0.0, 1.0)
    rgb = colours[0] * (1.0 + grain + tone - foot - 0.22 * np.maximum(joints, brick))
    rgb = mix(rgb, 0.8 * colours[1], band(v, texels.v_size, height - 0.35, height - 0.05))
    glazed = np.flatnonzero((window > 0.0) & (v < height - 0.3))
    if len(glazed):
        chosen = colours[..., glazed], parameters[:, glazed]
        rgb[:, glazed] = _windows(rgb[:, glazed], _take(texels, glazed), *chosen)
    return rgb


def _windows(
    rgb: Float32Array, texels: Texels, colours: Float32Array, parameters: Float32Array
) -> Float32Array:
    """Rows of framed windows, and doors on the ground floor, painted over a wall ``(3, N)``."""
    floor, spacing, window, tall = parameters[:4]
    u, v = texels.u - 0.5 * (spacing - window), texels.v
    column, storey = np.floor((u + 0.5 * (spacing - window)) / spacing), np.floor(v / floor)
    salt = texels.shift
    luck = cell_hash(column + salt, storey + texels.shift_v, 3)
    door = (storey == 0) & (luck > 0.8)
    blind = (luck < 0.1) & ~door
    low = np.where(door, np.float32(0.1), np.float32(0.85))
    high = np.where(door, np.float32(2.2), low + tall)
    x, y = u - column * spacing, v - storey * floor

    def opening(border: float) -> Float32Array:
        across = band(x, texels.u_size, -border, window + border)
        return np.asarray(across * band(y, texels.v_size, low - border, high + border))

    framed, pane = opening(0.11), opening(-0.03)
    # a cross of glazing bars, and panes that mirror a bright or a dark part of the street
    bars = band(x, texels.u_size, 0.5 * window - 0.035, 0.5 * window + 0.035)
    bars = np.maximum(
        bars, band(y, texels.v_size, low + 0.62 * tall - 0.03, low + 0.62 * tall + 0.03) * ~door
    )
    tone = cell_hash(column + salt, storey + texels.shift_v, 5)
    blotch = 0.1 * fractal(texels, (0.9, 0.7, 1.0))
    sheen = np.clip(0.12 + 0.55 * tone * tone + 0.25 * (y - low) / (high - low) + blotch, 0.03, 0.9)
    glass = sheen * np.array([[0.75], [0.85], [0.95]], dtype=np.float32)
    leaf = (0.3 + 0.5 * tone) * colours[1]
    inside = np.where(door, leaf, glass)
    inside = mix(inside, 0.8 * colours[1], bars * (window > 1.0))
    visible = ~blind
    rgb = mix(rgb, colours[1], framed * visible)
    return mix(rgb, inside, pane * visible)


def _roof(texels: Texels, colours: Float32Array, parameters: Float32Array) -> Float32Array:
    rows = stripes(texels.v, texels.v_size, 0.35, 0.09)
    tiles = stripes(texels.u, texels.u_size, 0.3, 0.05)
    grain = fractal(texels, (4.0, 3.0, 0.25), (0.9, 0.8, 0.22), (0.3, 0.35, 0.22))
    return np.asarray(colours[0] * (1.0 + grain - 0.3 * rows - 0.15 * tiles))


def _sign(texels: Texels, colours: Float32Array, parameters: Float32Array) -> Float32Array:
    half, kind = parameters[0], parameters[1]
    x = texels.u - half
    y = texels.v - half
    size = pixel_size(texels)
    edge = np.where(kind == 0, np.hypot(x, y), np.maximum(np.abs(x), np.abs(y))) / half
    rim = np.clip((edge - 0.72) * half / size + 0.5, 0.0, 1.0)
    bar = band(y, texels.v_size, -0.14 * half, 0.16 * half) * band(
        np.abs(x), texels.u_size, -1.0, 0.5 * half
    )
    plain = mix(colours[1], colours[0], np.maximum(rim, bar))
    inverse = mix(colours[0], colours[1], np.maximum(rim, bar))
    return np.asarray(np.where(kind == 2, inverse, plain))


def _paint(texels: Texels, colours: Float32Array, parameters: Float32Array) -> Float32Array:
    seams = np.maximum(
        stripes(texels.u - 0.2, texels.u_size, 1.05, 0.05), band(texels.v, texels.v_size, -0.1, 0.1)
    )
    light = (
        1.0
        + 0.25 * np.clip(texels.v - 0.3, -0.4, 0.5)
        + fractal(texels, (1.3, 0.3, 0.16), (0.3, 0.2, 0.1))
    )
    return mix(colours[0] * light, colours[1], 0.7 * seams)


def _glass(texels: Texels, colours: Float32Array, parameters: Float32Array) -> Float32Array:
    pillars = stripes(texels.u + 0.05, texels.u_size, 1.1, 0.14)
    sheen = np.clip(1.0 + 1.6 * fractal(texels, (0.8, 0.35, 1.0), (0.3, 0.2, 0.5)), 0.3, 4.0)
    rgb = colours[0] * sheen
    return mix(rgb, colours[1], np.maximum(pillars, band(texels.v, texels.v_size, -0.2, 0.05)))


def _tyre(texels: Texels, colours: Float32Array, parameters: Float32Array) -> Float32Array:
    return mix(
        colours[0], colours[1], band(np.hypot(texels.u, texels.v), pixel_size(texels), -1.0, 0.19)
    )


def _fence(texels: Texels, colours: Float32Array, parameters: Float32Array) -> Float32Array:
    gap, height = parameters[0], parameters[1]
    slats = stripes(texels.u, texels.u_size, gap, 0.35 * gap)
    rails = 1.0 - band(texels.v, texels.v_size, 0.78 * height, 0.88 * height)
    grain = fractal(texels, (1.7, 0.9, 0.25), (0.25, 0.8, 0.2))
    return mix(colours[0] * (1.0 + grain), colours[1], slats * rails)


def _take(texels: Texels, chosen: NDArray[np.int64]) -> Texels:
    """Some of the texels."""
    return Texels(*(getattr(texels, field.name)[chosen] for field in fields(Texels)))


STREET_SHADERS: dict[Material, Shader] = {
    Material.ASPHALT: _asphalt,
    Material.JUNCTION: _junction,
    Material.PAVEMENT: _pavement,
    Material.KERB: _kerb,
    Material.GRASS: _mottled(
        (24.0, 24.0, 0.3), (8.0, 8.0, 0.35), (2.5, 2.5, 0.35), (0.7, 0.7, 0.4), (0.2, 0.2, 0.4)
    ),
    Material.GRAVEL: _mottled((6.0, 6.0, 0.3), (1.2, 1.2, 0.3), (0.3, 0.3, 0.4), (0.1, 0.1, 0.3)),
    Material.WALL: _wall,
    Material.ROOF: _roof,
    Material.BARK: _mottled((0.12, 0.6, 0.5), (0.4, 1.5, 0.4)),
    Material.LEAVES: _mottled((1.6, 1.6, 0.4), (0.55, 0.55, 0.6), (0.2, 0.2, 0.5)),
    Material.METAL: grained((0.5, 1.3, 0.25), (0.2, 0.4, 0.2)),
    Material.SIGN: _sign,
    Material.PAINT: _paint,
    Material.GLASS: _glass,
    Material.TYRE: _tyre,
    Material.FENCE: _fence,
}
