"""Exports are whole files in the given axes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from meshes import coloured_ply

from slam.commands.export import export
from slam.formats.ply import read_ply, write_ply
from slam.frames import Intrinsics
from slam.loops.places import Places
from slam.results.folder import RunFolder
from slam.runtime.errors import RunError
from slam.runtime.files import PLACES

MakeRun = Callable[..., RunFolder]


@pytest.mark.parametrize("what", ["mesh", "cloud"])
def test_ply_is_written_as_it_is_or_rotated_into_a_new_folder(
    make_run: MakeRun, tmp_path: Path, what: str
) -> None:
    folder = make_run()
    source = folder.path / f"map_{what}.ply"
    copied = export(folder, what, tmp_path / "new" / "a.ply", "y-down")
    assert copied.read_bytes() == source.read_bytes()
    turned = export(folder, what, tmp_path / "new" / "b.ply", "z")
    np.testing.assert_allclose(
        read_ply(turned).points[2], [0, 1, 2]
    )  # the vertex 2 m above the road, (0, -2, 1)
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == ["a.ply", "b.ply"]


def keep_places(folder: RunFolder) -> None:
    camera = Intrinsics(416, 128, 230.0, 230.0, 207.0, 63.0)
    folder.write(PLACES, Places(camera, (), np.zeros((0, 4, 4))).write)


def test_an_option_without_effect_is_refused(make_run: MakeRun, tmp_path: Path) -> None:
    with pytest.raises(RunError, match="--points does nothing for mesh: it is for colmap"):
        export(make_run(), "mesh", tmp_path / "mesh.ply", points=5)


@pytest.mark.parametrize("up", ["y-down", "z"])
def test_colmap_has_camera_poses_and_cloud(make_run: MakeRun, tmp_path: Path, up: str) -> None:
    folder = make_run()
    keep_places(folder)
    written = export(folder, "colmap", tmp_path / "new" / "model", up)
    assert (written / "cameras.txt").read_text().splitlines()[
        1
    ] == "1 PINHOLE 416 128 230.0 230.0 207.5 63.5"
    assert len((written / "images.txt").read_text().splitlines()) == 1 + 2 * 300
    third = (written / "points3D.txt").read_text().splitlines()[3]
    assert third == ("3 0 -2 1 128 128 128 0" if up == "y-down" else "3 0 1 2 128 128 128 0")
    first = [
        float(word) for word in (written / "images.txt").read_text().splitlines()[1].split()[1:8]
    ]
    half = np.sqrt(0.5)  # z up: the camera's axes turned by 90 degrees about x
    expected = [1.0, 0, 0, 0, 0, 0, 0] if up == "y-down" else [half, half, 0, 0, 0, 0, 0]
    np.testing.assert_allclose(first, expected, atol=1e-9)


@pytest.mark.parametrize(
    ("what", "name", "why"),
    [
        ("colmap", "drive/thesis.ply", "is a file: .* the name of a folder"),
        ("mesh", "out.stl", r"written as \.ply; got 'out\.stl'"),
        ("occupancy", "out.png", r"written as \.yaml or \.pgm"),
        ("mesh", "folder.ply", "is a folder"),
        ("mesh", "run/map_mesh.ply", "is a file of a run"),
        ("occupancy", "camera.yaml", "camera.yaml is none of ours"),
        ("occupancy", "drive/photo.yaml", "photo.pgm is none of ours"),
        ("mesh", "drive/thesis.ply", "thesis.ply exists and is a file of another kind"),
        ("colmap", "drive", "drive/images is none of ours"),
    ],
)
def test_nothing_else_is_replaced(
    make_run: MakeRun, tmp_path: Path, what: str, name: str, why: str
) -> None:
    folder = make_run()
    (tmp_path / "drive/images").mkdir(parents=True)
    (tmp_path / "folder.ply").mkdir()
    (tmp_path / "drive/images.txt").write_text("another program's")
    (tmp_path / "camera.yaml").write_text("width: 40\n")
    (tmp_path / "drive/thesis.ply").write_text("my own")
    (tmp_path / "drive/photo.pgm").write_bytes(b"P5\n1 1\n255\n0")
    before = {path: path.is_dir() or path.read_bytes() for path in tmp_path.rglob("*")}
    with pytest.raises(RunError, match=why):
        export(folder, what, tmp_path / name)
    assert {path: path.is_dir() or path.read_bytes() for path in tmp_path.rglob("*")} == before


@pytest.mark.parametrize(("what", "missing"), [("mesh", "map_mesh.ply"), ("colmap", "places.npz")])
def test_a_part_the_run_lacks_is_named(
    make_run: MakeRun, tmp_path: Path, what: str, missing: str
) -> None:
    folder = make_run()
    keep_places(folder)
    (folder.path / missing).unlink()
    with pytest.raises(RunError, match=f"has no {missing}"):
        export(folder, what, tmp_path / "out.ply", "y-down")


def test_a_map_that_is_cut_short_is_not_exported(make_run: MakeRun, tmp_path: Path) -> None:
    folder = make_run()
    mesh = folder.path / "map_mesh.ply"
    mesh.write_bytes(mesh.read_bytes()[:-12])
    with pytest.raises(RunError, match=r"map_mesh\.ply is no PLY that can be read"):
        export(folder, "mesh", tmp_path / "out.ply")
    assert not (tmp_path / "out.ply").exists()


def test_an_estimate_that_lacks_rows_is_not_exported(make_run: MakeRun, tmp_path: Path) -> None:
    folder = make_run()
    keep_places(folder)
    path = folder.path / "trajectory_optimised.tum.txt"
    path.write_text("\n".join(path.read_text().splitlines()[:200]) + "\n")
    with pytest.raises(
        RunError, match=r"trajectory_optimised\.tum\.txt is damaged: it has 199 rows for 300 frames"
    ):
        export(folder, "colmap", tmp_path / "out", "y-down")
    assert not (tmp_path / "out").exists()


def test_a_grid_of_too_many_cells_is_one_line(make_recorded: MakeRun, tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"--resolution 1e-05 gives .* cells"):
        export(make_recorded(), "occupancy", tmp_path / "new" / "map.yaml", resolution=1e-5)
    assert not (tmp_path / "new").exists()


def test_an_empty_map_is_not_exported(make_recorded: MakeRun, tmp_path: Path) -> None:
    folder = make_recorded()
    nothing = np.zeros((0, 3))
    write_ply(
        folder.path / "map_mesh.ply",
        coloured_ply(nothing, nothing, nothing, np.zeros((0, 3), np.int64)),
    )
    with pytest.raises(RunError, match="the map is empty"):
        export(folder, "mesh", tmp_path / "m.ply")
