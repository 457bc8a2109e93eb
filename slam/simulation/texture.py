"""Procedural textures of all materials, from texture coordinates and the footprint of a pixel, without aliasing."""

import functools
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.simulation.geometry import Float32Array, Material

Lengths = NDArray[np.floating[Any]]

_SIZE = 256  # lattice cells before the noise repeats


@dataclass(frozen=True)
class Texels:
    """Texture coordinates of the pixels of one material; every field is ``(N,)``, metres."""

    u: Float32Array  # along the surface
    v: Float32Array  # across or up the surface
    u_size: Float32Array  # footprint of the pixel along u
    v_size: Float32Array  # footprint of the pixel along v
    shift: Float32Array  # offset of the instance in the noise along u
    shift_v: Float32Array  # the same along v


@functools.cache
def _lattice() -> Float32Array:
    """Random values in [-1, 1], flattened ``(_SIZE ** 2,)``."""
    return np.random.default_rng(20261121).uniform(-1.0, 1.0, _SIZE * _SIZE).astype(np.float32)


def value_noise(u: Float32Array, v: Float32Array) -> Float32Array:
    """Smooth noise in [-1, 1] with one lattice cell per unit, ``(N,)``."""
    table = _lattice()
    whole_u, whole_v = np.floor(u), np.floor(v)
    a, b = u - whole_u, v - whole_v
    a *= a * (3.0 - 2.0 * a)
    b *= b * (3.0 - 2.0 * b)
    i, j = whole_u.astype(np.int32), whole_v.astype(np.int32)
    left, right = (i & 255) << 8, ((i + 1) & 255) << 8
    low, high = j & 255, (j + 1) & 255
    bottom = np.take(table, left | low)
    bottom += a * (np.take(table, right | low) - bottom)
    top = np.take(table, left | high)
    top += a * (np.take(table, right | high) - top)
    top -= bottom
    top *= b
    top += bottom
    return top


def cell_hash(u: Float32Array, v: Float32Array, salt: int) -> Float32Array:
    """A random number in [0, 1] for each integer cell, ``(N,)``."""
    i = (np.floor(u).astype(np.int32) + 37 * salt) & 255
    j = (np.floor(v).astype(np.int32) + 101 * salt) & 255
    return np.asarray(0.5 + 0.5 * np.take(_lattice(), (i << 8) | j))


def fractal(texels: Texels, *octaves: tuple[float, float, float]) -> Float32Array:
    """Sum of noise octaves, each faded out where its waves are smaller than about two pixels.

    An octave is the wavelength along u and along v in metres, and the amplitude.
    """
    total = np.zeros_like(texels.u)
    for k, (wave_u, wave_v, amplitude) in enumerate(octaves):
        pixels = np.minimum(wave_u / texels.u_size, wave_v / texels.v_size)
        weight = np.clip((pixels - 1.2) / 1.8, 0.0, 1.0)
        seen = np.flatnonzero(weight > 0.0)
        u = (texels.u[seen] + texels.shift[seen]) / wave_u + 17.3 * k
        v = (texels.v[seen] + texels.shift_v[seen]) / wave_v + 5.7 * k
        total[seen] += amplitude * weight[seen] * value_noise(u, v)
    return total


def stripes(
    x: Lengths, size: Lengths, period: Lengths | float, width: Lengths | float
) -> Float32Array:
    """Fraction of each pixel covered by stripes [k period, k period + width], filtered over ``size``."""
    half = 0.5 * np.maximum(size, 1e-4)

    def integral(at: Lengths) -> Lengths:
        whole = np.floor(at / period)
        return np.asarray(whole * width + np.minimum(at - whole * period, width))

    return np.asarray((integral(x + half) - integral(x - half)) / (2.0 * half))


def band(x: Lengths, size: Lengths, low: Lengths | float, high: Lengths | float) -> Float32Array:
    """Fraction of each pixel covered by the one stripe [low, high]."""
    inverse = 1.0 / np.maximum(size, 1e-4)
    return np.asarray(
        np.clip((x - low) * inverse + 0.5, 0, 1) - np.clip((x - high) * inverse + 0.5, 0, 1)
    )


def mix(
    a: Lengths | np.floating[Any], b: Lengths | np.floating[Any], fraction: Lengths
) -> Float32Array:
    """Blend colours ``(3, N)`` by a weight ``(N,)``."""
    return np.asarray(a + fraction * (b - a), dtype=np.float32)


GLOWING = {Material.SCREEN: 1.3, Material.PANE: 2.2, Material.LAMP: 2.5}  # light of their own
_INK = np.array([[0.12], [0.12], [0.14]], dtype=np.float32)


# unlit RGB (3, N), about [0, 1], of texels by the two colours (2, 3, N) and the parameters (PARAMETERS, N) of instances
Shader = Callable[[Texels, Float32Array, Float32Array], Float32Array]


def _size(texels: Texels) -> Float32Array:
    return np.maximum(texels.u_size, texels.v_size)


def _rim(texels: Texels, width: Lengths, height: Lengths, border: Lengths | float) -> Float32Array:
    """Coverage by the border of a rectangle that begins at the origin."""
    inside = band(texels.u, texels.u_size, border, width - border)
    return np.asarray(1.0 - inside * band(texels.v, texels.v_size, border, height - border))


def _text(texels: Texels, line: Lengths | float, letter: float) -> Float32Array:
    """Coverage by lines of words."""
    row = np.floor(texels.v / line)
    word = cell_hash(texels.u / letter + texels.shift, row + texels.shift_v, 7) > 0.35
    near = np.clip(letter / _size(texels) - 0.7, 0.0, 1.0)
    written = word * near + 0.65 * (1.0 - near)
    return np.asarray(stripes(texels.v, texels.v_size, line, 0.55 * line) * written)


def _plaster(texels: Texels, colours: Float32Array, parameters: Float32Array) -> Float32Array:
    skirting, period, contrast = parameters[:3]
    grain = fractal(
        texels, (2.3, 1.9, 0.02), (0.4, 0.4, 0.012), (0.05, 0.05, 0.02), (0.015, 0.015, 0.02)
    )
    figure = stripes(
        texels.u, texels.u_size, np.maximum(period, 0.05), 0.4 * np.maximum(period, 0.05)
    ) * (period > 0)
    rgb = colours[0] * (1.0 + grain - contrast * figure)
    return mix(
        rgb,
        colours[1] * (1.0 + grain),
        band(texels.v, texels.v_size, -1.0, skirting) * (skirting > 0),
    )


def _tiles(texels: Texels, colours: Float32Array, parameters: Float32Array) -> Float32Array:
    side, joint = parameters[0], parameters[1]
    joints = np.maximum(
        stripes(texels.u, texels.u_size, side, joint), stripes(texels.v, texels.v_size, side, joint)
    )
    near = np.clip(side / _size(texels) / 2.0 - 0.5, 0.0, 1.0)
    tone = 0.07 * near * (cell_hash(texels.u / side, texels.v / side, 1) - 0.5)
    grain = fractal(texels, (0.5, 0.4, 0.03), (0.06, 0.05, 0.03))
    chequered = (np.floor(texels.u / side) + np.floor(texels.v / side)) % 2 * parameters[2] * near
    return mix(
        mix(colours[0] * (1.0 + grain + tone), 0.5 * colours[1], chequered), colours[1], joints
    )


def _boards(texels: Texels, colours: Float32Array, parameters: Float32Array) -> Float32Array:
    width = parameters[0]
    row = np.floor(texels.v / width)
    along = np.asarray(texels.u + 0.9 * cell_hash(row, row, 2), dtype=np.float32)
    near = np.clip(width / texels.v_size - 1.0, 0.0, 1.0)
    tone = 0.3 * near * (cell_hash(np.divide(along, 0.9, dtype=np.float32), row, 4) - 0.5)
    veins = fractal(texels, (0.9, 0.06, 0.1), (0.25, 0.02, 0.12), (0.08, 0.008, 0.1))
    gaps = np.maximum(
        stripes(texels.v, texels.v_size, width, 0.006), stripes(along, texels.u_size, 0.9, 0.006)
    )
    return np.asarray(colours[0] * (1.0 + tone + veins) * (1.0 - 0.55 * gaps))


def _carpet(texels: Texels, colours: Float32Array, parameters: Float32Array) -> Float32Array:
    width, height, motif = parameters[:3]
    u, v = texels.u - 0.5 * width, texels.v - 0.5 * height
    lozenge = np.abs((u / motif) % 1.0 - 0.5) + np.abs((v / motif) % 1.0 - 0.5)
    soft = _size(texels) / motif
    figure = np.clip((0.3 - lozenge) / np.maximum(soft, 0.02) + 0.5, 0.0, 1.0) * np.clip(
        0.7 / soft - 1.0, 0.0, 1.0
    )
    border = _rim(texels, width, height, 0.18) - _rim(texels, width, height, 0.08)
    grain = 1.0 + fractal(texels, (0.3, 0.3, 0.08), (0.03, 0.03, 0.12), (0.01, 0.01, 0.15))
    return mix(colours[0], colours[1], np.maximum(figure, border)) * grain


def _wood(texels: Texels, colours: Float32Array, parameters: Float32Array) -> Float32Array:
    width, height = np.where(parameters[:2] > 0.0, parameters[:2], 9.0)  # of a door
    veins = fractal(texels, (0.03, 0.5, 0.09), (0.01, 0.25, 0.08), (0.3, 1.1, 0.1))
    gaps = np.maximum(
        stripes(texels.u, texels.u_size, width, 0.008),
        stripes(texels.v, texels.v_size, height, 0.008),
    )
    knob = np.hypot(texels.u % width - 0.87 * width, texels.v % height - 0.5 * height)
    knobs = np.clip((0.022 - knob) / _size(texels) + 0.5, 0.0, 1.0) * (width < 9.0)
    return mix(colours[0] * (1.0 + veins) * (1.0 - 0.6 * gaps), colours[1], knobs)


def _books(texels: Texels, colours: Float32Array, parameters: Float32Array) -> Float32Array:
    """Rows of spines of all colours between boards; the upper part of a row is dark."""
    width, height, row = parameters[:3]
    shelf = np.floor(texels.v / row)
    v = texels.v - shelf * row
    cell = texels.u / 0.045 + 0.3 * cell_hash(shelf, shelf + texels.shift, 3)
    spine = np.floor(cell + 0.35 * cell_hash(cell, shelf + texels.shift, 5))
    luck = [cell_hash(spine + texels.shift, shelf + texels.shift_v, salt) for salt in (11, 12, 13)]
    filled = cell_hash((spine / 7.0 + texels.shift).astype(np.float32), shelf, 14) > 0.15
    tall = row * (0.55 + 0.33 * luck[0]) * filled
    near = np.clip(0.045 / texels.u_size - 0.4, 0.0, 1.0)
    spines = 0.1 + 0.55 * (0.5 * np.stack(luck) + 0.5 * luck[0]).astype(np.float32) * (
        0.5 + 0.5 * luck[1]
    )
    title = band(v, texels.v_size, 0.6 * tall, 0.75 * tall) * (luck[2] > 0.5)
    rgb = mix(np.float32(0.42), mix(spines, 1.0 - 0.6 * spines, 0.8 * title), near)
    rgb = mix(0.25 * colours[0], rgb, band(v, texels.v_size, 0.0, tall))
    boards = np.maximum(
        stripes(texels.v + 0.012, texels.v_size, row, 0.024), _rim(texels, width, height, 0.025)
    )
    return mix(rgb, colours[0] * (1.0 + fractal(texels, (0.4, 0.05, 0.1))), boards)


def _picture(texels: Texels, colours: Float32Array, parameters: Float32Array) -> Float32Array:
    """A painting of blots, or a poster of a picture and text, in a frame."""
    width, height, kind = parameters[:3]
    blot = fractal(texels, (0.31, 0.27, 1.0), (0.12, 0.11, 0.7), (0.05, 0.05, 0.4))
    first, second = (
        np.clip(9.0 * blot + 0.5, 0.0, 1.0),
        np.clip(9.0 * np.abs(blot - 0.3) - 1.2, 0.0, 1.0),
    )
    third = np.stack([colours[1][2], colours[0][0], colours[1][0]])
    rgb = mix(mix(third, colours[0], second), colours[1], first)
    line = 0.03 + 0.02 * (kind - 1.0)
    paper = np.asarray(mix(np.float32(0.9), _INK, _text(texels, line, 0.035)))
    written = band(texels.v, texels.v_size, 0.0, 0.38 * height) * (kind > 0)
    rgb = mix(rgb, paper, written)
    return mix(rgb, np.where(kind > 0, 0.92, 0.25 * colours[0]), _rim(texels, width, height, 0.03))


def _screen(texels: Texels, colours: Float32Array, parameters: Float32Array) -> Float32Array:
    """Windows of text on a desktop."""
    width, height = parameters[:2]
    pane = (texels.u % (0.5 * width) > 0.03 * width) & (texels.v % (0.7 * height) > 0.06 * height)
    rgb = mix(colours[1], mix(np.float32(0.85), _INK, _text(texels, 0.018, 0.02)), pane)
    return mix(rgb, 0.3 * _INK, _rim(texels, width, height, 0.015))


def _pane(texels: Texels, colours: Float32Array, parameters: Float32Array) -> Float32Array:
    """A bright window or a mirror, with a frame and a cross of bars."""
    width, height, bars = parameters[:3]
    bar = band(texels.u, texels.u_size, 0.5 * width - 0.02, 0.5 * width + 0.02)
    bar = (
        np.maximum(bar, band(texels.v, texels.v_size, 0.65 * height - 0.02, 0.65 * height + 0.02))
        * bars
    )
    sheen = 1.0 + 0.1 * (texels.v / height - 0.5) + fractal(texels, (0.9, 0.7, 0.05))
    return mix(colours[0] * sheen, colours[1], np.maximum(bar, _rim(texels, width, height, 0.045)))


def _carton(texels: Texels, colours: Float32Array, parameters: Float32Array) -> Float32Array:
    width, height = parameters[:2]
    grain = fractal(texels, (0.6, 0.5, 0.07), (0.1, 0.1, 0.05), (0.015, 0.2, 0.04))
    tape = band(texels.v, texels.v_size, 0.47 * height, 0.47 * height + 0.05)
    rgb = mix(colours[0] * (1.0 + grain), 1.25 * colours[0], 0.7 * tape)
    label = band(texels.u, texels.u_size, 0.1 * width, 0.45 * width)
    label = (
        label * band(texels.v, texels.v_size, 0.08 * height, 0.38 * height) * (colours[1][0] > 0.3)
    )
    rgb = mix(rgb, mix(np.float32(0.88), colours[1] * 0.3, _text(texels, 0.035, 0.03)), label)
    return rgb * (1.0 - 0.35 * _rim(texels, width, height, 0.008))


def _asphalt(texels: Texels, colours: Float32Array, parameters: Float32Array) -> Float32Array:
    rgb = _junction(texels, colours, parameters)
    half, dash, fraction = parameters[0, 0], parameters[1, 0], parameters[2, 0]
    lengthways = stripes(texels.u, texels.u_size, float(2.0 * dash), float(2.0 * dash * fraction))
    lane = float(parameters[4, 0])
    if lane > 0.0:
        inside = np.abs(texels.v) < half - 3.0
        paint = lengthways * inside * stripes(texels.v + 0.07, texels.v_size, lane, 0.14)
    else:
        paint = lengthways * band(texels.v, texels.v_size, -0.07, 0.07)
    if parameters[3, 0] > 0.5:
        low, high = (
            (2.15, 2.03) if half > 4.5 else (0.35, 0.23)
        )  # beside parked cars, or beside the verge
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
    near = np.clip(slab / _size(texels) / 2.0 - 0.5, 0.0, 1.0)
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


def _grained(*octaves: tuple[float, float, float]) -> Shader:
    """One colour under noise."""
    return lambda texels, colours, _: np.asarray(colours[0] * (1.0 + fractal(texels, *octaves)))


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
    x, y, size = texels.u - half, texels.v - half, _size(texels)
    edge = np.where(kind == 0, np.hypot(x, y), np.maximum(np.abs(x), np.abs(y))) / half
    rim = np.clip((edge - 0.72) * half / size + 0.5, 0.0, 1.0)
    bar = band(y, texels.v_size, -0.14 * half, 0.16 * half) * band(
        np.abs(x), texels.u_size, -1.0, 0.5 * half
    )
    plain = mix(colours[1], colours[0], np.maximum(rim, bar))
    inverse = mix(colours[0], colours[1], np.maximum(rim, bar))
    return np.asarray(np.where((kind == 2), inverse, plain))


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
        colours[0], colours[1], band(np.hypot(texels.u, texels.v), _size(texels), -1.0, 0.19)
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


SHADERS: dict[Material, Shader] = {
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
    Material.METAL: _grained((0.5, 1.3, 0.25), (0.2, 0.4, 0.2)),
    Material.SIGN: _sign,
    Material.PAINT: _paint,
    Material.GLASS: _glass,
    Material.TYRE: _tyre,
    Material.FENCE: _fence,
    Material.PLASTER: _plaster,
    Material.TILES: _tiles,
    Material.BOARDS: _boards,
    Material.CARPET: _carpet,
    Material.WOOD: _wood,
    Material.FABRIC: _grained(
        (0.6, 0.6, 0.08), (0.12, 0.12, 0.07), (0.02, 0.02, 0.12), (0.008, 0.008, 0.12)
    ),
    Material.BOOKS: _books,
    Material.PICTURE: _picture,
    Material.SCREEN: _screen,
    Material.PANE: _pane,
    Material.CARTON: _carton,
    Material.LAMP: _grained(),
}
