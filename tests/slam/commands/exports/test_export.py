"""Exports are whole files in the given axes."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from slam.commands.exports.export import export
from slam.commands.exports.options import R_UP_WORLDS
from slam.formats.ply import read_ply
from slam.formats.trajectory import read_trajectory
from slam.frames import Intrinsics
from slam.loops.places import Places
from slam.results.folder import RunFolder
from slam.results.metrics import Metrics
from slam.runtime.errors import RunError, TrajectoryError
from slam.runtime.run_files import PLACES

MakeRun = Callable[..., RunFolder]


R_UP_WORLD = R_UP_WORLDS["z"]


def test_z_up_axes_are_a_rotation_with_the_sky_above_and_the_road_ahead() -> None:
    np.testing.assert_allclose(R_UP_WORLD @ R_UP_WORLD.T, np.eye(3))
    assert np.linalg.det(R_UP_WORLD) == pytest.approx(1.0)
    up_of_camera, ahead_of_camera, right = [0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]
    np.testing.assert_allclose(R_UP_WORLD @ up_of_camera, [0.0, 0.0, 1.0])
    np.testing.assert_allclose(R_UP_WORLD @ ahead_of_camera, [0.0, 1.0, 0.0])
    np.testing.assert_allclose(R_UP_WORLD @ right, right)


@pytest.mark.parametrize("what", ["mesh", "cloud"])
def test_ply_is_copied_or_rotated_into_a_new_folder(make_run: MakeRun, tmp_path: Path, what: str) -> None:
    folder = make_run()
    source = folder.path / f"map_{what}.ply"
    copied = export(folder, what, tmp_path / "new" / "a.ply", "y-down")
    assert copied.read_bytes() == source.read_bytes()
    turned = export(folder, what, tmp_path / "new" / "b.ply", "z")
    np.testing.assert_allclose(read_ply(turned).points[2], [0, 1, 2])  # the vertex 2 m above the road, (0, -2, 1)
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == ["a.ply", "b.ply"]


@pytest.mark.parametrize(("name", "format"), [("t.txt", "kitti"), ("t.tum", "tum"), ("t.tum.txt", "tum")])
def test_trajectory_format_follows_the_name(make_run: MakeRun, tmp_path: Path, name: str, format: str) -> None:
    folder = make_run()
    written = export(folder, "trajectory", tmp_path / name, "y-down")
    source = folder.path / f"trajectory_optimised.{format}.txt"
    read, original = read_trajectory(written), read_trajectory(source)
    np.testing.assert_allclose(read.T_world_camera, original.T_world_camera, atol=1e-6)
    assert read.timed == (format == "tum")


def test_trajectory_with_z_up_rotates_the_world_only(make_run: MakeRun, tmp_path: Path) -> None:
    folder = make_run()
    down = read_trajectory(export(folder, "trajectory", tmp_path / "a.tum", "y-down"))
    up = read_trajectory(export(folder, "trajectory", tmp_path / "b.tum", "z"))
    np.testing.assert_allclose(up.positions[:, 1], down.positions[:, 2], atol=1e-6)
    np.testing.assert_allclose(up.T_world_camera[0, :3, :3], R_UP_WORLD, atol=1e-6)


def test_graph_is_copied(make_run: MakeRun, tmp_path: Path) -> None:
    folder = make_run()
    written = export(folder, "graph", tmp_path / "g.g2o", "y-down")
    assert written.read_bytes() == (folder.path / "graph.g2o").read_bytes()


def keep_places(folder: RunFolder) -> None:
    camera = Intrinsics(416, 128, 230.0, 230.0, 207.0, 63.0)
    folder.write(PLACES, Places(camera, (), np.zeros((0, 4, 4))).write)


@pytest.mark.parametrize("up", ["y-down", "z"])
def test_colmap_has_camera_poses_and_cloud(make_run: MakeRun, tmp_path: Path, up: str) -> None:
    folder = make_run()
    keep_places(folder)
    written = export(folder, "colmap", tmp_path / "new" / "model", up)
    assert (written / "cameras.txt").read_text().splitlines()[1] == "1 PINHOLE 416 128 230.0 230.0 207.5 63.5"
    assert len((written / "images.txt").read_text().splitlines()) == 1 + 2 * 300
    third = (written / "points3D.txt").read_text().splitlines()[3]
    assert third == ("3 0 -2 1 128 128 128 0" if up == "y-down" else "3 0 1 2 128 128 128 0")
    first = [float(word) for word in (written / "images.txt").read_text().splitlines()[1].split()[1:8]]
    half = np.sqrt(0.5)  # z up: the camera's axes turned by 90 degrees about x
    expected = [1.0, 0, 0, 0, 0, 0, 0] if up == "y-down" else [half, half, 0, 0, 0, 0, 0]
    np.testing.assert_allclose(first, expected, atol=1e-9)


def test_colmap_without_a_map_has_no_points(make_run: MakeRun, tmp_path: Path) -> None:
    folder = make_run()
    keep_places(folder)
    (folder.path / "map_cloud.ply").unlink()
    written = export(folder, "colmap", tmp_path / "model", "y-down")
    assert len((written / "points3D.txt").read_text().splitlines()) == 1


@pytest.mark.parametrize(
    ("what", "name", "up", "why"),
    [
        ("colmap", "file", "y-down", "is a file: .* the name of a folder"),
        ("video", "out.mp4", "y-down", "unknown: choose one of mesh, cloud, trajectory, graph, colmap, nerfstudio"),
        ("mesh", "out.stl", "y-down", r"written as \.ply, \.glb, \.gltf; got 'out\.stl'"),
        ("cloud", "out.glb", "y-down", r"written as \.ply, \.las, \.laz"),
        ("occupancy", "out.png", "z", r"ends in \.yaml"),
        ("raster", "file", "z", "is a file: a raster is several files"),
        ("nerfstudio", "file", "z", "is a file: a scene is several files"),
        ("raster", "folder", "y-up", "leave --up out or give --up z"),
        ("mesh", "out.ply", "x", "y-down, z or y-up"),
        ("graph", "out.g2o", "z", "leave --up out"),
        ("mesh", "", "y-down", "is a folder"),
        ("graph", "file/out.g2o", "y-down", "cannot be written"),
        ("trajectory", "file/out.tum", "y-down", r"target/file/out\.tum: cannot be written"),
    ],
)
def test_errors_are_clear_and_leave_nothing(
    make_run: MakeRun, tmp_path: Path, what: str, name: str, up: str, why: str
) -> None:
    folder = make_run()
    target = tmp_path / "target"
    target.mkdir()
    (target / "file").write_text("in the way")
    with pytest.raises((RunError, TrajectoryError), match=why):
        export(folder, what, target / name, up)
    assert [path.name for path in target.iterdir()] == ["file"]


@pytest.mark.parametrize(
    ("what", "name", "why"),
    [
        ("trajectory", "run/trajectory_network.tum.txt", "is a file of a run"),
        ("mesh", "run/map_mesh.ply", "is a file of a run"),
        ("trajectory", "camera.yaml", r"exists and does not end in \.txt or \.tum"),
        ("graph", "camera.yaml", r"exists and does not end in \.g2o"),
        ("occupancy", "camera.yaml", "exists and is no map of ROS"),
        ("occupancy", "camera.pgm", "camera.yaml exists and is no map of ROS"),
        ("occupancy", "drive/photo.yaml", "photo.pgm exists and is no map of ROS"),
        ("mesh", "drive/thesis.ply", "thesis.ply exists and is a file of another kind"),
        ("trajectory", "drive/images.txt", "images.txt exists and is a file of another kind"),
        ("trajectory", "drive/truth.txt", "truth.txt belongs to the recording of the run"),
        ("nerfstudio", "drive", "drive/images is none of ours"),
        ("colmap", "drive", "drive/images is none of ours"),
        ("raster", "drive", "drive/height.png is none of ours"),
        ("raster", "terrain", "terrain/raster.yaml is none of ours"),
    ],
)
def test_nothing_else_is_replaced(make_run: MakeRun, tmp_path: Path, what: str, name: str, why: str) -> None:
    folder = make_run()
    (tmp_path / "drive/images").mkdir(parents=True)
    for other in ("images.txt", "height.png"):
        (tmp_path / "drive" / other).write_text("another program's")
    (tmp_path / "camera.yaml").write_text("width: 40\n")
    (tmp_path / "drive/thesis.ply").write_text("my own")
    (tmp_path / "drive/photo.pgm").write_bytes(b"P5\n1 1\n255\n0")
    (tmp_path / "terrain").mkdir()
    (tmp_path / "terrain/raster.yaml").write_text("heights: my own\n")
    shutil.copy(folder.path / "reference.kitti.txt", tmp_path / "drive/truth.txt")
    metrics = folder.metrics().tree()
    metrics["provenance"]["recording"] = {"dataset": str(tmp_path / "drive")}
    folder.write_metrics(Metrics.model_validate(metrics))
    folder.write_text("config.yaml", "")
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    with pytest.raises(RunError, match=why):
        export(folder, what, tmp_path / name)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize(
    ("what", "missing"),
    [
        ("mesh", "map_mesh.ply"),
        ("trajectory", "trajectory_optimised.tum.txt"),
        ("colmap", "places.npz"),
        ("raster", "map_mesh.ply"),
    ],
)
def test_a_part_the_run_lacks_is_named(make_run: MakeRun, tmp_path: Path, what: str, missing: str) -> None:
    folder = make_run()
    keep_places(folder)
    (folder.path / missing).unlink()
    with pytest.raises(RunError, match=f"has no {missing}"):
        export(folder, what, tmp_path / "out.ply", "y-down")


def cut(path: Path, at: int) -> None:
    path.write_bytes(path.read_bytes()[:at])


@pytest.mark.parametrize("up", ["y-down", "z"])
@pytest.mark.parametrize("what", ["mesh", "cloud"])
def test_a_map_that_is_cut_short_is_not_exported(make_run: MakeRun, tmp_path: Path, what: str, up: str) -> None:
    folder = make_run()
    cut(folder.path / f"map_{what}.ply", -12)
    with pytest.raises(RunError, match=rf"map_{what}\.ply is no PLY that can be read"):
        export(folder, what, tmp_path / "out.ply", up)
    assert not (tmp_path / "out.ply").exists()


@pytest.mark.parametrize("at", [-3, -20, 30])
def test_a_graph_that_is_cut_short_is_not_exported(make_run: MakeRun, tmp_path: Path, at: int) -> None:
    folder = make_run()
    cut(folder.path / "graph.g2o", at)
    with pytest.raises(RunError, match=r"graph\.g2o is no pose graph"):
        export(folder, "graph", tmp_path / "out.g2o", "y-down")
    assert not (tmp_path / "out.g2o").exists()


def test_a_trajectory_that_lacks_rows_is_not_exported(make_run: MakeRun, tmp_path: Path) -> None:
    folder = make_run()
    path = folder.path / "trajectory_optimised.tum.txt"
    path.write_text("\n".join(path.read_text().splitlines()[:200]) + "\n")
    with pytest.raises(RunError, match=r"trajectory_optimised\.tum\.txt is damaged: it has 199 rows for 300 frames"):
        export(folder, "trajectory", tmp_path / "out.txt", "y-down")
    assert not (tmp_path / "out.txt").exists()
