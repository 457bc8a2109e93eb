"""Procedural textures of what is inside a house: walls, floors, furniture, pictures and lamps."""

import numpy as np

from slam.simulation.texture import Lengths, Shader, Texels, cell_hash, grained, mix, slabs

# light of their own
GLOWING: dict[str, float] = {"screen": 1.3, "pane": 2.2, "lamp": 2.5}


def _plaster(texels: Texels) -> Lengths:
    skirting, period, contrast = texels.parameters[:3]
    grain = texels.fractal(
        (2.3, 1.9, 0.02), (0.4, 0.4, 0.012), (0.05, 0.05, 0.02), (0.015, 0.015, 0.02)
    )
    step = np.maximum(period, 0.05)
    figure = texels.u.stripes(step, 0.4 * step) * (period > 0)
    rgb = texels.first * (1.0 + grain - contrast * figure)
    return mix(rgb, texels.second * (1.0 + grain), texels.v.band(-1.0, skirting) * (skirting > 0))


def _boards(texels: Texels) -> Lengths:
    width = texels.parameters[0]
    row = np.floor(texels.v.at / width)
    along = texels.u.at + 0.9 * cell_hash(row, row, 2)
    near = np.clip(width / texels.v.size - 1.0, 0.0, 1.0)
    tone = 0.3 * near * (cell_hash(along / 0.9, row, 4) - 0.5)
    veins = texels.fractal((0.9, 0.06, 0.1), (0.25, 0.02, 0.12), (0.08, 0.008, 0.1))
    gaps = np.maximum(texels.v.stripes(width, 0.006), texels.u.on(along).stripes(0.9, 0.006))
    return texels.first * (1.0 + tone + veins) * (1.0 - 0.55 * gaps)


def _carpet(texels: Texels) -> Lengths:
    motif = texels.parameters[2]
    figure = texels.u.stripes(motif, 0.5 * motif) * texels.v.stripes(motif, 0.5 * motif)
    border = texels.rim(0.18) - texels.rim(0.08)
    grain = 1.0 + texels.fractal((0.3, 0.3, 0.08), (0.03, 0.03, 0.12), (0.01, 0.01, 0.15))
    return mix(texels.first, texels.second, np.maximum(figure, border)) * grain


def _wood(texels: Texels) -> Lengths:
    width, height = np.where(texels.parameters[:2] > 0.0, texels.parameters[:2], 9.0)  # of a door
    veins = texels.fractal((0.03, 0.5, 0.09), (0.01, 0.25, 0.08), (0.3, 1.1, 0.1))
    gaps = texels.joints(width, height, 0.008)
    knob = np.hypot(texels.u.at % width - 0.87 * width, texels.v.at % height - 0.5 * height)
    knobs = np.clip((0.022 - knob) / texels.size + 0.5, 0.0, 1.0) * (width < 9.0)
    return mix(texels.first * (1.0 + veins) * (1.0 - 0.6 * gaps), texels.second, knobs)


def _books(texels: Texels) -> Lengths:
    """Rows of spines of all colours between boards; the upper part of a row is dark."""
    row, shift = texels.parameters[2], texels.u.shift
    shelf = np.floor(texels.v.at / row)
    above = texels.v.on(texels.v.at - shelf * row)
    cell = texels.u.at / 0.045
    spine = np.floor(cell + 0.35 * cell_hash(cell, shelf + shift, 5)) + shift
    spines = np.stack([cell_hash(spine, shelf + texels.v.shift, salt) for salt in (11, 12, 13)])
    near = np.clip(0.045 / texels.u.size - 0.4, 0.0, 1.0)
    rgb = mix(np.float32(0.35), 0.1 + 0.5 * spines, near)
    rgb = mix(0.25 * texels.first, rgb, above.band(0.0, row * (0.55 + 0.33 * spines[0])))
    boards = np.maximum(texels.v.stripes(row, 0.024, 0.012), texels.rim(0.025))
    return mix(rgb, texels.first * (1.0 + texels.fractal((0.4, 0.05, 0.1))), boards)


def _picture(texels: Texels) -> Lengths:
    """Blots of three colours in a frame."""
    blot = texels.fractal((0.31, 0.27, 1.0), (0.12, 0.11, 0.7), (0.05, 0.05, 0.6))
    first = np.clip(9.0 * blot + 0.5, 0.0, 1.0)
    second = np.clip(9.0 * np.abs(blot - 0.3) - 1.2, 0.0, 1.0)
    third = np.stack([texels.second[2], texels.first[0], texels.second[0]])
    rgb = mix(mix(third, texels.first, second), texels.second, first)
    return mix(rgb, 0.25 * texels.first, texels.rim(0.03))


def _pane(texels: Texels) -> Lengths:
    """A bright window or a mirror, with a frame and a cross of bars."""
    width, height, bars = texels.parameters[:3]
    upright = texels.u.band(0.5 * width - 0.02, 0.5 * width + 0.02)
    level = texels.v.band(0.65 * height - 0.02, 0.65 * height + 0.02)
    bar = np.maximum(upright, level) * bars
    sheen = 1.0 + 0.1 * (texels.v.at / height - 0.5) + texels.fractal((0.9, 0.7, 0.05))
    return mix(texels.first * sheen, texels.second, np.maximum(bar, texels.rim(0.045)))


def _carton(texels: Texels) -> Lengths:
    _, height = texels.parameters[:2]
    grain = texels.fractal((0.6, 0.5, 0.07), (0.1, 0.1, 0.08), (0.02, 0.06, 0.08))
    tape = texels.v.band(0.47 * height, 0.47 * height + 0.05)
    rgb = mix(texels.first * (1.0 + grain), texels.second, 0.7 * tape)
    return rgb * (1.0 - 0.35 * texels.rim(0.008))


ROOM_SHADERS: dict[str, Shader] = {
    "plaster": _plaster,
    "tiles": slabs(0.07, (0.5, 0.4, 0.03), (0.06, 0.05, 0.03)),
    "boards": _boards,
    "carpet": _carpet,
    "wood": _wood,
    "fabric": grained(
        (0.6, 0.6, 0.08), (0.12, 0.12, 0.07), (0.02, 0.02, 0.12), (0.008, 0.008, 0.12)
    ),
    "books": _books,
    "picture": _picture,
    "screen": _picture,
    "pane": _pane,
    "carton": _carton,
    "lamp": grained(),
}
