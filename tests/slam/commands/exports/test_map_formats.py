"""Meshes and clouds read back by other programs: the same vertices and colours."""

from __future__ import annotations

import base64
import importlib
import json
import resource
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slam.commands.exports.export import export
from slam.commands.exports.options import R_UP_WORLDS, ExportOptions, parse_crop, parse_origin
from slam.formats.ply import Ply, coloured_ply, read_ply, write_ply
from slam.geometry.se3 import FloatArray
from slam.results.folder import RunFolder
from slam.runtime.errors import RunError, SlamError
from slam.runtime.imports import import_open3d

MakeRecorded = Callable[..., RunFolder]


def by_open3d(path: Path) -> tuple[FloatArray, FloatArray, FloatArray]:
    mesh = import_open3d().io.read_triangle_mesh(str(path))
    return np.asarray(mesh.vertices), np.asarray(mesh.vertex_colors), np.asarray(mesh.triangles)


def surface(points: FloatArray, triangles: FloatArray) -> FloatArray:
    """The corners of all triangles, each triangle and all of them in a fixed order."""
    corners = np.sort(points[triangles.astype(int)].reshape(len(triangles), 9).round(5), axis=1)
    return corners[np.lexsort(corners.T)]


@pytest.mark.parametrize("up", ["y-down", "z", "y-up"])
@pytest.mark.parametrize("name", ["m.ply", "m.glb", "m.gltf", "M.GLB"])
def test_open3d_reads_the_same_mesh(
    make_recorded: MakeRecorded, sheet: Ply, tmp_path: Path, name: str, up: str
) -> None:
    written = export(make_recorded(), "mesh", tmp_path / "out" / name, up)
    assert [path.name for path in written.parent.iterdir()] == [name]
    points, colours, triangles = by_open3d(written)
    wanted = sheet.points @ R_UP_WORLDS[up].T
    assert sheet.triangles is not None and sheet.colours is not None
    np.testing.assert_allclose(surface(points, triangles), surface(wanted, sheet.triangles), atol=2e-5)
    # readers may reorder vertices: each is found by its place
    distance, nearest = nearest_of(wanted, points)
    assert distance.max() < 1e-6
    shown = colours if name.endswith(".ply") else as_srgb(colours)
    np.testing.assert_allclose(shown, sheet.colours[nearest] / 255.0, atol=1 / 255)


def as_srgb(linear: FloatArray) -> FloatArray:
    """What a viewer of glTF shows of a linear colour, 0 to 1."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def nearest_of(points: FloatArray, places: FloatArray) -> tuple[FloatArray, Any]:
    distances = np.linalg.norm(points[None] - places[:, None], axis=2)
    return distances.min(axis=1), distances.argmin(axis=1)


@pytest.mark.parametrize("name", ["m.glb", "m.gltf"])
def test_gltf_is_exact_and_well_formed(make_recorded: MakeRecorded, sheet: Ply, tmp_path: Path, name: str) -> None:
    content = export(make_recorded(), "mesh", tmp_path / name).read_bytes()
    if name == "m.glb":
        magic, version, length, size, kind = struct.unpack("<4sIII4s", content[:20])
        assert (magic, version, length, kind) == (b"glTF", 2, len(content), b"JSON") and size % 4 == 0
        document = json.loads(content[20 : 20 + size])
        rest, kind = struct.unpack("<I4s", content[20 + size : 28 + size])
        buffer = content[28 + size :]
        assert kind == b"BIN\0" and rest == len(buffer)
    else:
        document = json.loads(content)
        buffer = base64.b64decode(document["buffers"][0]["uri"].partition(",")[2])
    assert document["buffers"][0]["byteLength"] == len(buffer)
    primitive = document["meshes"][0]["primitives"][0]

    def array(number: int, dtype: str, width: int) -> Any:
        accessor = document["accessors"][number]
        view = document["bufferViews"][accessor["bufferView"]]
        return np.frombuffer(buffer, dtype, accessor["count"] * width, view["byteOffset"]).reshape(-1, width)

    points = array(primitive["attributes"]["POSITION"], "<f4", 3)
    np.testing.assert_array_equal(points, sheet.points)
    colours = array(primitive["attributes"]["COLOR_0"], "<u2", 4) / 65535
    np.testing.assert_array_equal(np.rint(255 * as_srgb(colours[:, :3])), sheet.colours)
    assert (colours[:, 3] == 1.0).all()
    np.testing.assert_array_equal(array(primitive["indices"], "<u4", 1).reshape(-1, 3), sheet.triangles)
    bounds = document["accessors"][primitive["attributes"]["POSITION"]]
    np.testing.assert_array_equal([bounds["min"], bounds["max"]], [points.min(axis=0), points.max(axis=0)])


@pytest.mark.parametrize("name", ["c.las", "c.laz", "C.LAZ"])
def test_laspy_reads_the_same_cloud(make_recorded: MakeRecorded, sheet: Ply, tmp_path: Path, name: str) -> None:
    laspy = pytest.importorskip("laspy")
    pytest.importorskip("lazrs")
    written = export(make_recorded(), "cloud", tmp_path / name, "z")
    las = laspy.read(written)
    assert las.header.are_points_compressed == name.lower().endswith("z")
    np.testing.assert_allclose(las.xyz, sheet.points @ R_UP_WORLDS["z"].T, atol=0.6e-4)
    colours = np.stack([las.red, las.green, las.blue], axis=1)
    np.testing.assert_array_equal(colours >> 8, sheet.colours)


@pytest.mark.parametrize(
    ("what", "name", "options", "missing", "extra"),
    [("cloud", "c.laz", "", "lazrs", "las"), ("raster", "raster", "49,8,0", "rasterio", "geotiff")],
)
def test_an_absent_extra_is_named(
    make_recorded: MakeRecorded,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    what: str,
    name: str,
    options: str,
    missing: str,
    extra: str,
) -> None:
    folder, there = make_recorded(), importlib.import_module

    def absent(module: str, *rest: Any) -> Any:
        if module == missing:
            raise ModuleNotFoundError(f"No module named '{module}'")
        return there(module, *rest)

    monkeypatch.setattr(importlib, "import_module", absent)
    with pytest.raises(SlamError, match=rf"pip install 'erfsfm-slam\[{extra}\]'"):
        export(folder, what, tmp_path / "new" / name, "z", ExportOptions(origin=parse_origin(options or None)))
    assert not (tmp_path / "new").exists()


def test_a_cropped_mesh_lies_inside_and_is_whole_there(make_recorded: MakeRecorded, sheet: Ply, tmp_path: Path) -> None:
    options = ExportOptions(crop=parse_crop("0.45,inf,-9,9,-inf,3.05"))
    cut = read_ply(export(make_recorded(), "mesh", tmp_path / "m.ply", "y-down", options))
    assert cut.triangles is not None and cut.points[:, 0].min() >= 0.45 and cut.points[:, 2].max() <= 3.05
    assert len(cut.vertices) == 15 * 11 and len(cut.triangles) == 14 * 10 * 2
    distances, nearest = nearest_of(sheet.points, cut.points)
    assert distances.max() == 0 and sheet.colours is not None
    np.testing.assert_array_equal(cut.colours, sheet.colours[nearest])


def test_the_crop_is_in_the_axes_of_the_run(make_recorded: MakeRecorded, tmp_path: Path) -> None:
    options = ExportOptions(crop=parse_crop("-1,9,1,2,2,2.55"))
    cloud = read_ply(export(make_recorded(), "cloud", tmp_path / "c.ply", "z", options))
    assert len(cloud.vertices) == 20 * 6 and cloud.points[:, 1].max() <= 2.55


@pytest.mark.parametrize("what", ["mesh", "cloud"])
def test_voxels_thin(make_recorded: MakeRecorded, tmp_path: Path, what: str) -> None:
    thin = read_ply(export(make_recorded(), what, tmp_path / "t.ply", "y-down", ExportOptions(voxel=0.4)))
    assert 20 <= len(thin.vertices) <= 80 and thin.colours is not None
    np.testing.assert_allclose(thin.points.mean(axis=0), [0.95, 1.5, 3.45], atol=0.15)
    np.testing.assert_allclose(thin.colours.mean(), 127.5, atol=12)
    assert thin.normals is not None
    np.testing.assert_allclose(np.linalg.norm(thin.normals, axis=1), 1, atol=1e-6)


def test_triangles_are_fewer_on_the_same_surface(make_recorded: MakeRecorded, sheet: Ply, tmp_path: Path) -> None:
    few = read_ply(export(make_recorded(), "mesh", tmp_path / "m.ply", "y-down", ExportOptions(triangles=200)))
    assert few.triangles is not None and 150 <= len(few.triangles) <= 200
    assert nearest_of(sheet.points, few.points)[0].max() < 0.12 and few.colours is not None


def test_more_triangles_than_there_are_change_nothing(make_recorded: MakeRecorded, sheet: Ply, tmp_path: Path) -> None:
    same = read_ply(export(make_recorded(), "mesh", tmp_path / "m.ply", "y-down", ExportOptions(triangles=10**6)))
    np.testing.assert_array_equal(same.triangles, sheet.triangles)


def test_other_vertex_fields_survive(make_recorded: MakeRecorded, sheet: Ply, tmp_path: Path) -> None:
    folder = make_recorded()
    kinds = [*((name, sheet.vertices.dtype[name]) for name in sheet.vertices.dtype.names or ()), ("filled", "u1")]
    vertices = np.zeros(len(sheet.vertices), kinds)
    for name in sheet.vertices.dtype.names or ():
        vertices[name] = sheet.vertices[name]
    vertices["filled"] = sheet.points[:, 0] > 1
    write_ply(folder.path / "map_mesh.ply", Ply(vertices, sheet.triangles))
    for k, options in enumerate([ExportOptions(crop=parse_crop("0,9,0,9,0,9")), ExportOptions(triangles=300)]):
        read = read_ply(export(folder, "mesh", tmp_path / f"{k}.ply", "z", options))
        far = np.abs(read.points[:, 0] - 1.05) > 0.1
        np.testing.assert_array_equal(read.vertices["filled"][far], read.points[far, 0] > 1)


@pytest.mark.parametrize(
    ("what", "options", "why"),
    [
        ("mesh", ExportOptions(crop=parse_crop("50,60,0,9,0,9")), "nothing of the map lies inside --crop: it reaches"),
        ("cloud", ExportOptions(crop=parse_crop("50,60,0,9,0,9")), "nothing of the map lies inside --crop"),
        ("mesh", ExportOptions(triangles=3), "--triangles 3 is too few: give 4 or more"),
        ("cloud", ExportOptions(triangles=30), "--triangles does nothing for cloud: it is for mesh"),
        ("trajectory", ExportOptions(voxel=1.0), "--voxel does nothing for trajectory"),
        ("mesh", ExportOptions(voxel=0.0), "--voxel 0.0 must be a positive length"),
        ("mesh", ExportOptions(voxel=float("nan")), "must be a positive length"),
        ("mesh", ExportOptions(voxel=100.0), "--voxel 100 leaves no triangle"),
        ("cloud", ExportOptions(voxel=1e-12), "is too small for a map that is .* wide"),
        ("raster", ExportOptions(resolution=1e-5), "--resolution 1e-05 gives .* cells"),
        ("mesh", ExportOptions(dataset=Path("x")), "--dataset does nothing for mesh: it is for colmap, nerfstudio"),
    ],
)
def test_errors_are_one_line_and_leave_nothing(
    make_recorded: MakeRecorded, tmp_path: Path, what: str, options: ExportOptions, why: str
) -> None:
    folder = make_recorded()
    with pytest.raises(RunError, match=why) as caught:
        export(folder, what, tmp_path / "new" / "out.ply", "y-down", options)
    assert "\n" not in str(caught.value) and not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("what", "name", "size", "origin"),
    [
        ("mesh", "m.glb", 2000, ""),
        ("cloud", "c.laz", 500, ""),
        ("cloud", "c.las", 500, ""),
        ("raster", "raster/colour.tif", 1000, "49,8,0"),
        ("occupancy", "map.pgm", 100, ""),
        ("nerfstudio", "scene/points.ply", 3000, ""),
    ],
)
def test_a_disk_that_is_full_is_one_line(
    make_recorded: MakeRecorded, tmp_path: Path, what: str, name: str, size: int, origin: str
) -> None:
    folder, output = make_recorded(), tmp_path / "new" / name
    target = output.parent if what in ("raster", "nerfstudio") else output
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        with pytest.raises(RunError, match="cannot be written") as caught:
            export(folder, what, target, "z", ExportOptions(origin=parse_origin(origin or None)))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert "\n" not in str(caught.value) and not output.exists()
    assert not [path.name for path in tmp_path.rglob(".*")]
    ends = {"raster.yaml", "transforms.json", "map.yaml"}
    assert not ends & {path.name for path in (tmp_path / "new").rglob("*")}


def test_an_empty_map_is_not_exported(make_recorded: MakeRecorded, tmp_path: Path) -> None:
    folder = make_recorded()
    nothing = np.zeros((0, 3))
    write_ply(folder.path / "map_mesh.ply", coloured_ply(nothing, nothing, nothing, np.zeros((0, 3), np.int64)))
    with pytest.raises(RunError, match="the map is empty"):
        export(folder, "mesh", tmp_path / "m.glb")


@pytest.mark.parametrize(
    "text", ["", "1,2,3", "1,2,3,4,5,6,7", "a,b,c,d,e,f", "0,1,0,1,0,nan", "1,0,0,1,0,1", "0,0,0,1,0,1"]
)
def test_crops_that_are_no_boxes_are_refused(text: str) -> None:
    with pytest.raises(RunError, match="--crop"):
        parse_crop(text)
