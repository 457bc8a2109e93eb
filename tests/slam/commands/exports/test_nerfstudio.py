"""A scene's images, poses and cloud belong together, and missing images are one line."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from slam.commands.export import R_UP_WORLDS, export
from slam.formats.ply import Ply
from slam.formats.trajectory import Trajectory
from slam.geometry.se3 import invert
from slam.loops.places import Places
from slam.results.folder import RunFolder
from slam.results.metrics import Metrics
from slam.runtime.errors import RunError
from slam.runtime.files import PLACES
from slam.runtime.imports import import_open3d
from slam.sequences.catalogue import open_sequence

MakeRecorded = Callable[..., RunFolder]


def scene(folder: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((folder / "transforms.json").read_text())
    return content


@pytest.mark.parametrize("up", ["y-down", "z"])
def test_points_project_to_their_pixels(
    make_recorded: MakeRecorded, sheet: Ply, tmp_path: Path, up: str
) -> None:
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


def test_images_of_a_lens_are_undistorted(make_recorded: MakeRecorded, tmp_path: Path) -> None:
    folder = make_recorded()
    camera_file = tmp_path / "drive" / "camera.yaml"
    camera_file.write_text(camera_file.read_text() + "model: opencv\ndistortion: [-0.3, 0, 0, 0]\n")
    with pytest.raises(RunError, match="another camera"):
        export(folder, "nerfstudio", tmp_path / "scene")
    camera = open_sequence(tmp_path / "drive").intrinsics
    folder.write(PLACES, Places(camera, (), np.zeros((0, 4, 4))).write)
    content = scene(export(folder, "nerfstudio", tmp_path / "scene"))
    assert content["fl_x"] == camera.fx and content["k1"] == 0


def test_frames_without_a_usable_image_are_left_out(
    make_recorded: MakeRecorded, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
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
) -> None:
    model = export(make_recorded(bridged=(5,)), "colmap", tmp_path / "model")
    images = [line.split() for line in (model / "images.txt").read_text().splitlines()[1::2]]
    assert [(row[0], row[-1]) for row in images] == [
        (str(k + 1), f"{k:06d}.png") for k in range(8) if k != 5
    ]


def test_a_run_of_a_part_finds_its_frames(make_recorded: MakeRecorded, tmp_path: Path) -> None:
    folder = make_recorded()
    trajectory = folder.trajectory("optimised")
    assert trajectory is not None
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
) -> None:
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
    assert trajectory is not None
    folder.write_trajectory(
        "optimised", Trajectory(trajectory.stamps + 100, trajectory.T_world_camera, True)
    )
    with pytest.raises(RunError, match="has no frame at the times of"):
        export(folder, "nerfstudio", tmp_path / "another", dataset=tmp_path / "elsewhere")
