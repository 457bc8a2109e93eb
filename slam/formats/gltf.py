"""Meshes as glTF 2.0, binary (``.glb``) or text with the buffer inside (``.gltf``).

Open3D 0.20 writes a ``.glb`` whose buffer lies outside its binary part, which its own reader refuses. The material
is unlit, for the colours are those of photographs, and seen from both sides, for the map is open.
"""

from __future__ import annotations

import base64
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.formats.ply import Ply
from slam.runtime.errors import RunError
from slam.runtime.storage.files import write_atomically

_FLOAT, _UNSIGNED_INT, _UNSIGNED_SHORT = 5126, 5125, 5123
_VERTICES, _INDICES = 34962, 34963
_MAGIC, _JSON, _BINARY = 0x46546C67, 0x4E4F534A, 0x004E4942
_OPAQUE = 65535


class _Buffer:
    """The binary part, and the views and accessors that describe it."""

    def __init__(self) -> None:
        self.content = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(self, array: NDArray[Any], component: int, kind: str, target: int, **more: Any) -> int:
        """Append an array; its size must be a multiple of 4 bytes. Returns the number of its accessor."""
        content = np.ascontiguousarray(array).tobytes()
        view = {"buffer": 0, "byteOffset": len(self.content), "byteLength": len(content), "target": target}
        accessor = {"bufferView": len(self.views), "componentType": component, "count": len(array), "type": kind}
        self.views.append(view)
        self.accessors.append(accessor | more)
        self.content += content
        return len(self.accessors) - 1


def write_gltf(path: Path, mesh: Ply) -> None:
    """Write a mesh, atomically; coordinates in single precision, colours linear as the format wants them.

    Args:
        path: ends in ``.glb`` or ``.gltf``.
        mesh: with triangles.

    Raises:
        RunError: the file cannot be written.
    """
    buffer = _Buffer()
    document = _document(mesh, buffer)
    if path.suffix.lower() == ".gltf":
        encoded = base64.b64encode(buffer.content).decode("ascii")
        document["buffers"][0]["uri"] = f"data:application/octet-stream;base64,{encoded}"
        whole = json.dumps(document).encode("ascii")
    else:
        text = json.dumps(document, separators=(",", ":")).encode("ascii")
        text += b" " * (-len(text) % 4)
        parts = ((_JSON, text), (_BINARY, bytes(buffer.content)))
        chunks = b"".join(struct.pack("<II", len(content), kind) + content for kind, content in parts)
        whole = struct.pack("<III", _MAGIC, 2, 12 + len(chunks)) + chunks
    write_atomically(path, lambda partial: partial.write_bytes(whole), RunError)


def _linear() -> NDArray[np.uint16]:
    """Linear light of the 256 levels of sRGB; in 8 bits the dark ones would fall together."""
    level = np.arange(256) / 255.0
    light = np.where(level <= 0.04045, level / 12.92, ((level + 0.055) / 1.055) ** 2.4)
    return np.asarray(np.rint(_OPAQUE * light), np.uint16)


def _document(mesh: Ply, buffer: _Buffer) -> dict[str, Any]:
    points = mesh.points.astype(np.float32)
    low, high = points.min(axis=0).tolist(), points.max(axis=0).tolist()
    attributes = {"POSITION": buffer.add(points, _FLOAT, "VEC3", _VERTICES, min=low, max=high)}
    if mesh.normals is not None:
        lengths = np.linalg.norm(mesh.normals, axis=1, keepdims=True)
        upright = np.where(lengths > 0, mesh.normals / np.where(lengths > 0, lengths, 1), [0.0, 0.0, 1.0])
        attributes["NORMAL"] = buffer.add(upright.astype(np.float32), _FLOAT, "VEC3", _VERTICES)
    if mesh.colours is not None:
        colours = np.column_stack([_linear()[mesh.colours], np.full(len(points), _OPAQUE, np.uint16)])
        attributes["COLOR_0"] = buffer.add(colours, _UNSIGNED_SHORT, "VEC4", _VERTICES, normalized=True)
    assert mesh.triangles is not None
    corners = mesh.triangles.astype(np.uint32).reshape(-1)
    indices = buffer.add(corners, _UNSIGNED_INT, "SCALAR", _INDICES)
    material = {
        "doubleSided": True,
        "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0},
        "extensions": {"KHR_materials_unlit": {}},
    }
    return {
        "asset": {"version": "2.0", "generator": "erfsfm-slam"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "map"}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": indices, "material": 0}]}],
        "materials": [material],
        "buffers": [{"byteLength": len(buffer.content)}],
        "bufferViews": buffer.views,
        "accessors": buffer.accessors,
    }
