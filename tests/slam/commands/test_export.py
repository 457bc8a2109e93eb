"""Exports are whole files in the given axes: maps, COLMAP models, nerfstudio scenes, grids of a run."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from erfsfm.common.readers.camera_file import read_camera_file
from slam.commands.cli import app
from slam.commands.export import R_UP_WORLDS, export
from slam.formats.ply import Ply, read_ply
from slam.formats.trajectory import Trajectory
from slam.frames import Frame, Intrinsics
from slam.geometry.se3 import FloatArray, apply, invert
from slam.loops.features import FeatureExtractor
from slam.loops.places import Places
from slam.mapping.occupancy import FREE
from slam.results.folder import RunFolder
from slam.results.metrics import Metrics, ScaleMetrics
from slam.runtime.errors import RunError
from slam.runtime.files import PLACES
from slam.runtime.imports import import_open3d
from slam.sequences.catalogue import open_sequence
from slam.simulation.recording import SimulatedSequence
from slam.simulation.street import SimulationOptions

MakeRun = Callable[..., RunFolder]
FRAMES, STRIDE = 18, 2
MakeRecorded = Callable[..., RunFolder]


@pytest.mark.parametrize("what", ["mesh", "cloud"])
def test_ply_is_written_as_it_is_or_rotated_into_a_new_folder(
    make_run: MakeRun, tmp_path: Path, what: str
):
    folder = make_run()
    source = folder.path / f"map_{what}.ply"
    copied = export(folder, what, tmp_path / "new" / "a.ply")
    assert copied.read_bytes() == source.read_bytes()
    turned = export(folder, what, tmp_path / "new" / "b.ply", "z")
    np.testing.assert_allclose(
        read_ply(turned).points[2], [0, 1, 2]
    )  # the vertex 2 m above the road, (0, -2, 1)
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == ["a.ply", "b.ply"]


def keep_places(folder: RunFolder) -> None:
    camera = Intrinsics(416, 128, 230.0, 230.0, 207.0, 63.0)
    folder.write(PLACES, Places(camera, (), np.zeros((0, 4, 4))).write)


def test_an_option_without_effect_is_refused(make_run: MakeRun, tmp_path: Path):
    with pytest.raises(RunError, match="--points does nothing for mesh: it is for colmap"):
        export(make_run(), "mesh", tmp_path / "mesh.ply", points=5)


@pytest.mark.parametrize("up", ["y-down", "z"])
def test_colmap_has_camera_poses_and_cloud(make_run: MakeRun, tmp_path: Path, up: str):
    folder = make_run()
    keep_places(folder)
    written = export(folder, "colmap", tmp_path / "new" / "model", up)
    assert (written / "cameras.txt").read_text().splitlines()[
        1
    ] == "1 PINHOLE 416 128 230.0 230.0 207.5 63.5"
    assert len((written / "images.txt").read_text().splitlines()) == 1 + 2 * 300
    third = (written / "points3D.txt").read_text().splitlines()[3]
    assert third == ("3 0 -2 1 128 128 128 -1" if up == "y-down" else "3 0 1 2 128 128 128 -1")
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
):
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
def test_a_part_the_run_lacks_is_named(make_run: MakeRun, tmp_path: Path, what: str, missing: str):
    folder = make_run()
    keep_places(folder)
    (folder.path / missing).unlink()
    with pytest.raises(RunError, match=f"has no {missing}"):
        export(folder, what, tmp_path / "out.ply")


def test_a_map_that_is_cut_short_is_not_exported(make_run: MakeRun, tmp_path: Path):
    folder = make_run()
    mesh = folder.path / "map_mesh.ply"
    mesh.write_bytes(mesh.read_bytes()[:-12])
    with pytest.raises(RunError, match=r"map_mesh\.ply is no PLY that can be read"):
        export(folder, "mesh", tmp_path / "out.ply")
    assert not (tmp_path / "out.ply").exists()


def test_an_estimate_that_lacks_rows_is_not_exported(make_run: MakeRun, tmp_path: Path):
    folder = make_run()
    keep_places(folder)
    path = folder.path / "trajectory_optimised.tum.txt"
    path.write_text("\n".join(path.read_text().splitlines()[:200]) + "\n")
    with pytest.raises(
        RunError, match=r"trajectory_optimised\.tum\.txt is damaged: it has 199 rows for 300 frames"
    ):
        export(folder, "colmap", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_grid_of_too_many_cells_is_one_line(make_recorded: MakeRun, tmp_path: Path):
    with pytest.raises(RunError, match=r"--resolution 1e-05 gives .* cells"):
        export(make_recorded(), "occupancy", tmp_path / "new" / "map.yaml", resolution=1e-5)
    assert not (tmp_path / "new").exists()


@pytest.fixture(scope="module")
def street() -> SimulatedSequence:
    return SimulatedSequence(SimulationOptions("straight", FRAMES, 630, 312, 96))


@pytest.fixture
def run(make_run: Callable[..., RunFolder], street: SimulatedSequence) -> RunFolder:
    """With the views of every second frame, without depth, at true poses; it does not record its images."""
    folder, extractor = make_run(), FeatureExtractor(street.intrinsics)
    assert street.reference is not None
    unknown = np.full((street.intrinsics.height, street.intrinsics.width), np.nan, np.float32)
    frames = range(0, FRAMES, STRIDE)
    views = tuple(extractor.view(Frame(k, 0.1 * k, street.frame(k).image), unknown) for k in frames)
    folder.write(PLACES, Places(street.intrinsics, views, street.reference[::STRIDE]).write)
    folder.write_trajectory("optimised", Trajectory(0.1 * np.arange(FRAMES), street.reference))
    folder.write_metrics(
        folder.metrics().changed(
            sequence=folder.metrics().sequence.model_copy(update={"frames": FRAMES})
        )
    )
    (folder.path / "map_cloud.ply").unlink()
    return folder


def rows(path: Path) -> list[list[str]]:
    return [line.split() for line in path.read_text().splitlines() if not line.startswith("#")]


def test_corners_are_tracked_through_the_images(
    run: RunFolder, street: SimulatedSequence, tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    model = export(run, "colmap", tmp_path / "model")
    assert "does not record where its images are: the model has none" in caplog.text
    points, images = rows(model / "points3D.txt"), rows(model / "images.txt")
    assert len(points) > 100 and len(images) == 2 * FRAMES
    X: FloatArray = np.array([point[1:4] for point in points], float)
    seen = 0
    for k, point in enumerate(points):
        for image, corner in zip(map(int, point[8::2]), map(int, point[9::2]), strict=True):
            corners = images[2 * image - 1]
            u, v, number = corners[3 * corner : 3 * corner + 3]
            assert int(number) == k + 1
            projected = street.intrinsics.project(
                apply(invert(street.reference[image - 1]), X[k][None])
            )[0]
            assert np.linalg.norm(projected + 0.5 - [float(u), float(v)]) < 4.0
            seen += 1
    assert seen >= 3 * len(points) == 3 * sum(len(point) >= 8 + 2 * 3 for point in points)
    T_street_first = street.street.T_world_camera[0]
    assert np.median(street.street.distance_to_surface(apply(T_street_first, X))) < 0.5


def test_points_are_chosen_by_the_length_of_their_tracks(run: RunFolder, tmp_path: Path):
    whole = [len(point) for point in rows(export(run, "colmap", tmp_path / "all") / "points3D.txt")]
    few = rows(export(run, "colmap", tmp_path / "few", "z", points=20) / "points3D.txt")
    assert [len(point) for point in few] == sorted(whole, reverse=True)[:20]
    X = np.array([point[1:4] for point in few], float)
    assert (X[:, 1] > 0).all(), "y is ahead where z is up"


def scene(folder: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((folder / "transforms.json").read_text())
    return content


@pytest.mark.parametrize("up", ["y-down", "z"])
def test_points_project_to_their_pixels(
    make_recorded: MakeRecorded, sheet: Ply, tmp_path: Path, up: str
):
    """By the convention of the format alone: x right, y up, z backwards, pixel centres at a half."""
    folder = make_recorded()
    written = export(folder, "nerfstudio", tmp_path / "scene", up)
    content = scene(written)
    camera = open_sequence(tmp_path / "drive").intrinsics
    trajectory = folder.trajectory("optimised")
    assert trajectory is not None and len(content["frames"]) == 8
    cloud = import_open3d().io.read_point_cloud(str(written / content["ply_file_path"]))
    points = np.asarray(cloud.points)
    np.testing.assert_allclose(points, sheet.points @ R_UP_WORLDS[up].T, atol=1e-9)
    np.testing.assert_allclose(np.asarray(cloud.colors) * 255, sheet.colours, atol=1)
    for k, frame in enumerate(content["frames"]):
        T_camera_world = np.linalg.inv(np.array(frame["transform_matrix"]))
        x, y, z = T_camera_world[:3, :3] @ points.T + T_camera_world[:3, 3:]
        u = content["fl_x"] * x / -z + content["cx"]
        v = content["fl_y"] * -y / -z + content["cy"]
        in_camera = sheet.points @ invert(trajectory.T_world_camera[k])[:3, :3].T
        in_camera += invert(trajectory.T_world_camera[k])[:3, 3]
        pixels = in_camera @ camera.K.T
        np.testing.assert_allclose(
            np.stack([u, v]).T - 0.5, pixels[:, :2] / pixels[:, 2:], atol=1e-6
        )


def test_images_of_a_lens_are_undistorted(make_recorded: MakeRecorded, tmp_path: Path):
    folder = make_recorded()
    camera_file = tmp_path / "drive" / "camera.yaml"
    lens = "model: opencv\ndistortion: [-0.3, 0, 0, 0]\nfx_sigma: 0.1\n"
    camera_file.write_text(camera_file.read_text() + lens)
    with pytest.raises(RunError, match="another camera"):
        export(folder, "nerfstudio", tmp_path / "scene")
    camera = open_sequence(tmp_path / "drive").intrinsics
    folder.write(PLACES, Places(camera, (), np.zeros((0, 4, 4))).write)
    content = scene(export(folder, "nerfstudio", tmp_path / "scene"))
    assert content["fl_x"] == camera.fx and content["k1"] == 0
    written = read_camera_file(tmp_path / "scene" / "camera.yaml")  # for erfsfm train
    assert (written.fx, written.fx_sigma) == (camera.fx, 0.1) and not written.is_distorted


def test_frames_without_a_usable_image_are_left_out(
    make_recorded: MakeRecorded, tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    folder = make_recorded(broken=(2,), bridged=(5,))
    (folder.path / "map_cloud.ply").unlink()
    written, sequence = (
        export(folder, "nerfstudio", tmp_path / "scene"),
        open_sequence(tmp_path / "drive"),
    )
    assert "ply_file_path" not in scene(written) and not (written / "points.ply").exists()
    for frame in scene(written)["frames"]:
        image, number = (
            cv2.imread(str(written / frame["file_path"])),
            int(Path(frame["file_path"]).stem),
        )
        np.testing.assert_array_equal(image[..., ::-1], sequence.frame(number).image)
    names = [f"images/{k:06d}.png" for k in (0, 1, 3, 4, 6, 7)]
    assert [frame["file_path"] for frame in scene(written)["frames"]] == names
    assert (
        sorted(path.relative_to(written).as_posix() for path in (written / "images").iterdir())
        == names
    )
    assert "2 of 8 frames have no usable image" in caplog.text


def test_interpolated_frames_are_no_images_of_a_colmap_model(
    make_recorded: MakeRecorded, tmp_path: Path
):
    model = export(make_recorded(bridged=(5,)), "colmap", tmp_path / "model")
    images = [line.split() for line in (model / "images.txt").read_text().splitlines()[1::2]]
    assert [(row[0], row[-1]) for row in images] == [
        (str(k + 1), f"{k:06d}.png") for k in range(8) if k != 5
    ]


def test_a_run_of_a_part_finds_its_frames(make_recorded: MakeRecorded, tmp_path: Path):
    folder = make_recorded()
    trajectory = folder.trajectory("optimised")
    folder.write_trajectory(
        "optimised", Trajectory(trajectory.stamps[3:6], trajectory.T_world_camera[3:6], True)
    )
    metrics = folder.metrics().tree()
    metrics["sequence"]["frames"] = 3
    folder.write_metrics(Metrics.model_validate(metrics))
    written = export(folder, "nerfstudio", tmp_path / "scene")
    shades = [
        int(cv2.imread(str(written / frame["file_path"]))[0, 0, 0])
        for frame in scene(written)["frames"]
    ]
    assert shades == [30, 40, 50]


def test_images_that_have_gone_are_one_line_and_a_new_place_is_taken(
    make_recorded: MakeRecorded, tmp_path: Path
):
    folder = make_recorded()
    shutil.move(tmp_path / "drive", tmp_path / "elsewhere")
    with pytest.raises(
        RunError, match=r"the images of .* are needed and not found .*; give --dataset ROOT"
    ) as caught:
        export(folder, "nerfstudio", tmp_path / "scene")
    assert "\n" not in str(caught.value) and not (tmp_path / "scene").exists()
    written = export(folder, "nerfstudio", tmp_path / "scene", "z", dataset=tmp_path / "elsewhere")
    assert len(scene(written)["frames"]) == 8
    trajectory = folder.trajectory("optimised")
    folder.write_trajectory(
        "optimised", Trajectory(trajectory.stamps + 100, trajectory.T_world_camera, True)
    )
    with pytest.raises(RunError, match="has no frame at the times of"):
        export(folder, "nerfstudio", tmp_path / "another", dataset=tmp_path / "elsewhere")


@pytest.mark.parametrize("name", ["map.yaml", "map.pgm"])
def test_the_grid_of_a_run(make_recorded: Callable[..., RunFolder], tmp_path: Path, name: str):
    written = export(make_recorded(), "occupancy", tmp_path / "new" / name, "z", resolution=0.2)
    assert sorted(path.name for path in written.parent.iterdir()) == ["map.pgm", "map.yaml"]
    described = yaml.safe_load(written.read_text())
    as_map_server = {"occupied_thresh": 0.65, "free_thresh": 0.196, "negate": 0}
    place = {"image": "map.pgm", "resolution": 0.2, "origin": [0.0, 2.0, 0.0]}
    assert written.name == "map.yaml" and described == place | as_map_server
    cells = cv2.imread(str(written.with_name(described["image"])), cv2.IMREAD_UNCHANGED)
    assert cells.shape == (15, 10) and (cells == FREE).mean() > 0.9


def test_a_grid_without_metres_says_so(
    make_recorded: Callable[..., RunFolder], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    folder, output = make_recorded(), tmp_path / "map.yaml"
    words = ["export", str(folder.path), "--what", "occupancy", "--output", str(output)]
    for unit, note in (("camera heights", True), ("metres", False)):
        folder.write_metrics(
            folder.metrics().changed(scale=ScaleMetrics(mode="none", value=9.8, unit=unit))
        )
        app(words, standalone_mode=False)
        assert ("not in metres" in capsys.readouterr().out) == note
        assert output.read_text().startswith(f"# lengths in {unit}\n") and yaml.safe_load(
            output.read_text()
        )
    own = ScaleMetrics(mode="none", unit="the networks' own unit")
    folder.write_metrics(folder.metrics().changed(scale=own))
    with pytest.raises(RunError, match="need metres or camera heights"):
        export(folder, "occupancy", output)
