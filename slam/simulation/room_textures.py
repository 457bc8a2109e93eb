"""Procedural textures of what is inside a house: walls, floors, furniture, pictures and lamps."""

import numpy as np

from slam.simulation.geometry import Float32Array, Material
from slam.simulation.texture import (
    Lengths,
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

GLOWING = {Material.SCREEN: 1.3, Material.PANE: 2.2, Material.LAMP: 2.5}  # light of their own
_INK = np.array([[0.12], [0.12], [0.14]], dtype=np.float32)


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
    near = np.clip(side / pixel_size(texels) / 2.0 - 0.5, 0.0, 1.0)
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
    soft = pixel_size(texels) / motif
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
    knobs = np.clip((0.022 - knob) / pixel_size(texels) + 0.5, 0.0, 1.0) * (width < 9.0)
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
    first = np.clip(9.0 * blot + 0.5, 0.0, 1.0)
    second = np.clip(9.0 * np.abs(blot - 0.3) - 1.2, 0.0, 1.0)
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


def _rim(texels: Texels, width: Lengths, height: Lengths, border: Lengths | float) -> Float32Array:
    """Coverage by the border of a rectangle that begins at the origin."""
    inside = band(texels.u, texels.u_size, border, width - border)
    return np.asarray(1.0 - inside * band(texels.v, texels.v_size, border, height - border))


def _text(texels: Texels, line: Lengths | float, letter: float) -> Float32Array:
    """Coverage by lines of words."""
    row = np.floor(texels.v / line)
    word = cell_hash(texels.u / letter + texels.shift, row + texels.shift_v, 7) > 0.35
    near = np.clip(letter / pixel_size(texels) - 0.7, 0.0, 1.0)
    written = word * near + 0.65 * (1.0 - near)
    return np.asarray(stripes(texels.v, texels.v_size, line, 0.55 * line) * written)


ROOM_SHADERS: dict[Material, Shader] = {
    Material.PLASTER: _plaster,
    Material.TILES: _tiles,
    Material.BOARDS: _boards,
    Material.CARPET: _carpet,
    Material.WOOD: _wood,
    Material.FABRIC: grained(
        (0.6, 0.6, 0.08), (0.12, 0.12, 0.07), (0.02, 0.02, 0.12), (0.008, 0.008, 0.12)
    ),
    Material.BOOKS: _books,
    Material.PICTURE: _picture,
    Material.SCREEN: _screen,
    Material.PANE: _pane,
    Material.CARTON: _carton,
    Material.LAMP: grained(),
}
