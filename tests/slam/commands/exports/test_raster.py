"""The map from above has each thing at its place, in every file that says where it is."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from slam.commands.exports.export import export
from slam.commands.exports.options import ExportOptions, Origin, parse_origin
from slam.commands.exports.raster import Raster, height_raster, write_raster
from slam.commands.exports.sampling import Grid, samples
from slam.formats.ply import Ply, coloured_ply
from slam.geometry.se3 import FloatArray
from slam.results.folder import RunFolder
from slam.results.metrics import ScaleMetrics
from slam.runtime.errors import RunError

GREEN, RED = (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)


def flat(x: tuple[float, float], y: tuple[float, float], z: float, colour: tuple[float, float, float]) -> Ply:
    """A horizontal rectangle."""
    points = np.array([[x[0], y[0], z], [x[1], y[0], z], [x[1], y[1], z], [x[0], y[1], z]])
    normals = np.tile([0.0, 0.0, 1.0], (4, 1))
    return coloured_ply(points, normals, np.tile(colour, (4, 1)), np.array([[0, 1, 2], [0, 2, 3]]))


def together(*meshes: Ply) -> Ply:
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    triangles = [mesh.triangles + start for mesh, start in zip(meshes, starts) if mesh.triangles is not None]
    return Ply(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(triangles))


@pytest.fixture
def scene() -> Ply:
    """A green floor 10 m wide and 20 m long, 1.5 m below, and a red roof over a part of it, ahead on the right."""
    return together(flat((-5, 5), (0, 20), -1.5, GREEN), flat((2, 4), (12, 15), 3.0, RED))


def value(raster: Raster, x: float, y: float) -> tuple[float, tuple[int, ...]]:
    row, column = divmod(int(raster.grid.cells(np.array([[x, y]]))[0]), raster.grid.width)
    return float(raster.heights[row, column]), tuple(raster.colours[row, column].tolist())


@pytest.mark.parametrize("resolution", [0.1, 0.25, 1.0])
def test_the_topmost_surface_counts(scene: Ply, resolution: float) -> None:
    raster = height_raster(scene, resolution, None)
    assert raster.known.all()
    assert value(raster, 3, 13.5) == (3.0, (255, 0, 0))
    for x, y in ((3, 10.5), (1, 13.5), (4.5, 13.5), (3, 16.5), (-3, 13.5)):
        assert value(raster, x, y) == (-1.5, (0, 255, 0))
    roof = (raster.heights == 3).sum() * resolution**2
    assert roof == pytest.approx(6, abs=1e-6)


def test_large_triangles_leave_no_holes_and_keep_their_area(scene: Ply) -> None:
    grid = Grid.around(scene.points, 0.07)
    areas, seen = 0.0, np.zeros(grid.width * grid.height, bool)
    for part in samples(scene, grid):
        areas += part.areas.sum()
        seen[grid.cells(part.points)] = True
    assert areas == pytest.approx(206) and seen.mean() > 0.985  # the border cells are cut by the edge


def test_files_read_back(scene: Ply, tmp_path: Path) -> None:
    raster = height_raster(scene, 0.5, None)
    write_raster(tmp_path / "new", raster, "metres")
    names = sorted(path.name for path in (tmp_path / "new").iterdir())
    assert names == ["colour.pgw", "colour.png", "height.pgw", "height.png", "raster.yaml"]
    described = yaml.safe_load((tmp_path / "new" / "raster.yaml").read_text())
    steps = cv2.imread(str(tmp_path / "new" / "height.png"), cv2.IMREAD_UNCHANGED)
    assert steps.dtype == np.uint16 and steps.shape == (described["height"], described["width"])
    heights = steps * described["heights"]["step"] + described["heights"]["offset"]
    np.testing.assert_allclose(heights, raster.heights, atol=1e-3)
    colours = cv2.imread(str(tmp_path / "new" / "colour.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(colours[..., 2::-1], raster.colours)
    assert (colours[..., 3] == 255).all()
    # the world file: x = a column + c, y = e row + f, at pixel centres
    a, d, b, e, c, f = map(float, (tmp_path / "new" / "colour.pgw").read_text().split())
    assert (b, d) == (0, 0)
    row, column = np.argwhere((colours[..., :3] == [0, 0, 255]).all(axis=2)).mean(axis=0)
    assert (a * column + c, e * row + f) == (pytest.approx(3), pytest.approx(13.5))
    assert described["top_left"] == [c - a / 2, f - e / 2] and described["axes"] == ["right", "ahead"]


def test_unknown_is_transparent_and_zero(tmp_path: Path) -> None:
    raster = height_raster(together(flat((0, 1), (0, 1), 0, RED), flat((5, 6), (0, 1), 70.0, RED)), 0.5, None)
    write_raster(tmp_path, raster, "metres")
    steps = cv2.imread(str(tmp_path / "height.png"), cv2.IMREAD_UNCHANGED)
    colours = cv2.imread(str(tmp_path / "colour.png"), cv2.IMREAD_UNCHANGED)
    known = np.zeros((2, 12), bool)
    known[:, [0, 1, 10, 11]] = True
    np.testing.assert_array_equal(steps > 0, known)
    np.testing.assert_array_equal(colours[..., 3] > 0, known)
    described = yaml.safe_load((tmp_path / "raster.yaml").read_text())["heights"]
    np.testing.assert_allclose(steps[0, -1] * described["step"] + described["offset"], 70, atol=described["step"])


@pytest.mark.parametrize("heading_deg", [0.0, 90.0, 213.0])
def test_geotiff_has_the_roof_at_its_place_on_earth(scene: Ply, tmp_path: Path, heading_deg: float) -> None:
    rasterio = pytest.importorskip("rasterio")
    from rasterio.warp import transform

    origin = Origin(49.011, 8.416, heading_deg)
    write_raster(tmp_path, height_raster(scene, 0.25, origin), "metres")
    with rasterio.open(tmp_path / "height.tif") as file:
        heights, crs = file.read(1), file.crs
        assert (file.count, file.dtypes[0]) == (1, "float32") and math.isnan(file.nodata)
        assert file.transform.a == 0.25 and file.transform.e == -0.25
        places = [file.xy(row, column) for row, column in np.argwhere(heights == 3)]
    east, north = np.mean(places, axis=0)
    # 3 m right and 13.5 m ahead of a camera that looks so far from north
    bearing, distance = math.radians(heading_deg) + math.atan2(3, 13.5), math.hypot(3, 13.5)
    assert (east, north) == pytest.approx((distance * math.sin(bearing), distance * math.cos(bearing)), abs=0.06)
    (longitude,), (latitude,) = transform(crs, "EPSG:4326", [east], [north])
    assert latitude == pytest.approx(49.011 + north / 111_220, abs=2e-7)
    assert longitude == pytest.approx(8.416 + east / (111_320 * math.cos(math.radians(49.011))), abs=5e-7)
    with rasterio.open(tmp_path / "colour.tif") as file:
        colours, mask = file.read(), file.dataset_mask()
        assert (file.count, file.dtypes[0]) == (3, "uint8")
    np.testing.assert_array_equal(colours[0][heights == 3], 255)
    np.testing.assert_array_equal(mask > 0, np.isfinite(heights))
    assert sorted(path.suffix for path in tmp_path.iterdir()) == [
        ".pgw",
        ".pgw",
        ".png",
        ".png",
        ".tif",
        ".tif",
        ".yaml",
    ]


def test_a_run_from_above(make_recorded: Callable[..., RunFolder], tmp_path: Path) -> None:
    written = export(make_recorded(), "raster", tmp_path / "raster", options=ExportOptions(resolution=0.2))
    described = yaml.safe_load((written / "raster.yaml").read_text())
    assert described["top_left"] == [0.0, 5.0] and described["unit"] == "metres"
    assert (described["width"], described["height"]) == (10, 15)


@pytest.mark.parametrize("unit", ["camera heights", "the networks' own unit"])
def test_without_metres_there_is_no_place_on_earth(
    make_recorded: Callable[..., RunFolder], tmp_path: Path, unit: str
) -> None:
    folder = make_recorded()
    folder.write_metrics(folder.metrics().changed(scale=ScaleMetrics(mode="none", unit=unit)))
    with pytest.raises(RunError, match=f"needs metres.* in {unit}"):
        export(folder, "raster", tmp_path / "r", options=ExportOptions(origin=parse_origin("49,8,0")))
    written = export(folder, "raster", tmp_path / "r", options=ExportOptions(resolution=0.5))
    assert yaml.safe_load((written / "raster.yaml").read_text())["unit"] == unit


def test_nothing_of_a_raster_before_stays(make_recorded: Callable[..., RunFolder], tmp_path: Path) -> None:
    folder, output, options = make_recorded(), tmp_path / "raster", ExportOptions(resolution=0.5)
    export(folder, "raster", output, options=options)
    names = sorted(path.name for path in output.iterdir())
    for name in ("height.tif", "colour.tif", "notes.txt"):
        (output / name).write_text("before")
    export(folder, "raster", output, options=options)
    assert sorted(path.name for path in output.iterdir()) == sorted([*names, "notes.txt"])
    (tmp_path / "drive" / "height.tif").write_text("mine")
    with pytest.raises(RunError, match=r"height\.tif is none of ours"):
        export(folder, "raster", tmp_path / "drive", options=options)


@pytest.mark.parametrize("text", ["", "49", "49,8", "91,8,0", "49,181,0", "49,8,north", "49,8,inf"])
def test_origins_that_are_no_places_are_refused(text: str) -> None:
    with pytest.raises(RunError, match=r"--origin .*LAT,LON,HEADING"):
        parse_origin(text)


def test_cells_and_centres_are_inverse() -> None:
    points: FloatArray = np.array([[-3.14, -2.7, 0], [5.6, 9.99, 0]])
    grid = Grid.around(points, 0.3)
    cells = np.arange(grid.width * grid.height)
    np.testing.assert_array_equal(grid.cells(grid.centres(cells)), cells)
    assert grid.x_min <= -3.14 and grid.y_max >= 9.99 and grid.y_min <= -2.7
