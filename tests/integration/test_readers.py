"""Every reader of files meets damaged ones: the answer is a value, or one line that names the file.

A sample is written, changed by Hypothesis and read again: the value is sound, or the line is about the file. One row
of `READERS` is all that a new reader needs.
"""

from __future__ import annotations

import io
import re
import shutil
import warnings
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from meshes import coloured_ply

from erfsfm.checkpoint import load_model
from erfsfm.common.errors import ErfsfmError
from erfsfm.common.readers.camera_file import read_camera_file
from erfsfm.common.readers.images import read_image, read_values
from erfsfm.common.readers.kitti import read_packet
from erfsfm.common.readers.video import VideoFrames
from erfsfm.config import load_experiment
from erfsfm.convert import read_old
from erfsfm.data.recordings import Recording
from erfsfm.data.split import read_split_file
from slam import run_slam
from slam.config.sections import load_config
from slam.formats.ply import read_ply, write_ply
from slam.formats.trajectory import Trajectory, read_trajectory
from slam.geometry import se3
from slam.loops.places import Places
from slam.results.metrics import LoopsFile, Metrics
from slam.runtime.errors import SlamError
from slam.sequences.catalogue import open_sequence

FEW = settings(
    max_examples=12,
    derandomize=True,
    deadline=None,
    database=None,
    suppress_health_check=[*HealthCheck],
)

_NUMBER = re.compile(rb"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")
_HOSTILE = (
    *(
        b"nan",
        b"inf",
        b"-inf",
        b"1e999",
        b"-1",
        b"0",
        b"1000000000000",
        b"9" * 60,
        b"1e308",
        b"1e-308",
        b"''",
    ),
    *(
        b"null",
        b"true",
        b"[]",
        b"{}",
        b"[[1]]",
        b'"x"',
        b"\\ud800",
        b"x",
        b"0x10",
        b"1_0",
        b"",
        b"~",
    ),
    b"!!python/name:os",
)
_LINE_ENDS = (b"\r\n", b"\r", b"\n\n", b"\x00", b" \n", b"\xc2\x85")


@st.composite
def damaged(draw: st.DrawFn, content: bytes) -> bytes:
    """A change of a file: bytes, length, numbers, line ends, encoding; inside an archive, of a member."""
    if zipfile.is_zipfile(io.BytesIO(content)) and draw(st.integers(0, 2)):
        return _with_member_changed(draw, content)
    size = len(content)
    place = draw(st.integers(0, min(size, draw(st.sampled_from([64, 1024, size])))))
    match draw(st.sampled_from(_CHANGES)):
        case "cut":
            return content[:place]
        case "flip":
            return (
                content[:place]
                + bytes([content[place] ^ 1 << draw(st.integers(0, 7))])
                + content[place + 1 :]
                if (place < size)
                else content
            )
        case "overwrite":
            new = draw(st.binary(min_size=1, max_size=16))
            return content[:place] + new + content[place + len(new) :]
        case "insert":
            return content[:place] + draw(st.binary(min_size=1, max_size=16)) + content[place:]
        case "remove":
            return content[:place] + content[place + draw(st.integers(1, 64)) :]
        case "repeat":
            return content[:place] + content[: draw(st.integers(0, size))]
        case "number":
            found = [*_NUMBER.finditer(content[:20_000])]
            if not found:
                return b""
            number = draw(st.sampled_from(found))
            return (
                content[: number.start()]
                + draw(st.sampled_from(_HOSTILE))
                + content[number.end() :]
            )
        case "line ends":
            return content.replace(b"\n", draw(st.sampled_from(_LINE_ENDS)))
        case "encoding":
            text = content.decode("latin-1")
            return text.encode(draw(st.sampled_from(["utf-16", "utf-32", "utf-8-sig", "utf-7"])))
        case "duplicate lines":
            lines = content.splitlines(keepends=True)
            return b"".join([*lines, lines[place % len(lines)]]) if lines else b""
    raise AssertionError("an unknown change")


_CHANGES = (
    *(
        "cut",
        "flip",
        "overwrite",
        "insert",
        "remove",
        "repeat",
        "number",
        "number",
        "line ends",
        "encoding",
    ),
    "duplicate lines",
)


def _with_member_changed(draw: st.DrawFn, content: bytes) -> bytes:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    chosen = draw(st.sampled_from(sorted(members)))
    if draw(st.integers(0, 5)):
        members[chosen] = draw(damaged(members[chosen]))
    else:
        del members[chosen]
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name, member in members.items():
            archive.writestr(name, member)
    return file.getvalue()


@dataclass(frozen=True)
class Reader:
    """A file of the samples, and what reads it; ``sound`` checks a value that came from a changed file."""

    name: str
    file: str
    read: Callable[[Path], Any]
    sound: Callable[[Any], bool] = lambda value: True


def _is_image(image: Any) -> bool:
    return image.dtype == np.uint8 and image.ndim == 3 and image.shape[2] == 3


def _is_trajectory(trajectory: Trajectory) -> bool:
    return se3.is_se3(trajectory.T_world_camera) and bool((np.diff(trajectory.stamps) > 0).all())


def _is_sequence(sequence: Any) -> bool:
    poses = sequence.reference
    return bool((np.diff(sequence.stamps) > 0).all()) and (
        poses is None or se3.is_se3(poses, tolerance=1e-3)
    )


def _odometry_poses(path: Path) -> Any:
    camera = read_camera_file(path.parents[1] / "camera.yaml").pinhole
    return Recording("sim", images=[path] * 8, camera=camera, poses_file=path).true_poses()


def _root(path: Path) -> Any:
    return open_sequence(path.parents[2], "sim")


def _euroc(path: Path) -> Any:
    return open_sequence(path.parents[2])


READERS = (
    Reader("PNG", "image.png", read_image, _is_image),
    Reader("PNG of 16 bits", "depth.png", read_values),
    Reader("JPEG", "image.jpg", read_image, _is_image),
    Reader("BMP", "image.bmp", read_image, _is_image),
    Reader("video", "drive.mp4", lambda path: VideoFrames(path).read(0), _is_image),
    Reader("camera.yaml", "root/camera.yaml", read_camera_file),
    Reader("settings of a run", "run/config.yaml", load_config),
    Reader("settings of a training", "training.yaml", lambda path: load_experiment(str(path))),
    Reader("split", "split.yaml", lambda path: read_split_file(str(path))),
    Reader("KITTI calibration", "root/sequences/sim/calib.txt", _root, _is_sequence),
    Reader("KITTI times", "root/sequences/sim/times.txt", _root, _is_sequence),
    Reader("KITTI poses", "run/trajectory_optimised.kitti.txt", read_trajectory, _is_trajectory),
    Reader(
        "KITTI poses, training",
        "root/poses/sim.txt",
        _odometry_poses,
        lambda T: bool(np.isfinite(T).all()),
    ),
    Reader("TUM poses", "run/trajectory_optimised.tum.txt", read_trajectory, _is_trajectory),
    Reader("TUM images", "tum/rgb.txt", lambda path: open_sequence(path.parent), _is_sequence),
    Reader(
        "folder times", "folder/times.txt", lambda path: open_sequence(path.parent), _is_sequence
    ),
    Reader("EuRoC images", "euroc/mav0/cam0/data.csv", _euroc, _is_sequence),
    Reader("EuRoC camera", "euroc/mav0/cam0/sensor.yaml", _euroc, _is_sequence),
    Reader(
        "OXTS packet", "packet.txt", read_packet, lambda packet: bool(np.isfinite(packet).all())
    ),
    Reader("metrics.json", "run/metrics.json", Metrics.read),
    Reader("loops.json", "run/loops.json", LoopsFile.read),
    Reader("places.npz", "run/places.npz", Places.read),
    Reader("PLY", "mesh.ply", read_ply, lambda ply: bool(np.isfinite(ply.points).all())),
    Reader("model.yaml", "weights/model.yaml", lambda path: load_model(path.parent)),
    Reader("safetensors", "weights/depth.safetensors", lambda path: load_model(path.parent)),
    Reader("checkpoint of SfMLearner", "old.pth.tar", read_old),
)


@pytest.fixture(scope="module")
def samples(tmp_path_factory: pytest.TempPathFactory, kitti_root: Path, tiny_weights: Path) -> Path:
    """A valid file for each reader."""
    place = tmp_path_factory.mktemp("samples")
    shutil.copytree(kitti_root, place / "root")
    shutil.copytree(tiny_weights, place / "weights")
    images = sorted((kitti_root / "sequences/sim/image_2").glob("*.png"))
    image = cv2.imread(str(images[0]))
    for suffix in ("png", "jpg", "bmp"):
        cv2.imwrite(str(place / f"image.{suffix}"), image)
    cv2.imwrite(str(place / "depth.png"), image[..., 0].astype(np.uint16) * 257)
    video = cv2.VideoWriter(
        str(place / "drive.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 10, image.shape[1::-1]
    )
    for path in images:
        video.write(cv2.imread(str(path)))
    video.release()
    (place / "tum/rgb").mkdir(parents=True)
    shutil.copy(kitti_root / "camera.yaml", place / "tum")
    for path in images:
        shutil.copy(path, place / "tum/rgb")
    (place / "tum/rgb.txt").write_text(
        "".join(f"{k / 10} rgb/{path.name}\n" for k, path in enumerate(images))
    )
    shutil.copytree(place / "tum/rgb", place / "folder")
    shutil.copy(kitti_root / "camera.yaml", place / "folder")
    (place / "folder/times.txt").write_text("".join(f"{k / 10}\n" for k in range(len(images))))
    _write_euroc(place / "euroc/mav0/cam0", images)
    (place / "packet.txt").write_text(" ".join(["49.01", "8.43", *["0.5"] * 28]))
    (place / "split.yaml").write_text(
        "train: [kitti_raw/a]\nvalidation: []\ntest: ['kitti_raw/b[0:10]']\n"
    )
    shutil.copy(Path(__file__).parents[2] / "configs/erfsfm/tiny.yaml", place / "training.yaml")
    triangle = np.eye(3)
    write_ply(place / "mesh.ply", coloured_ply(triangle, triangle, triangle, np.array([[0, 1, 2]])))
    _write_old_checkpoint(place / "old.pth.tar")
    overrides = ["output.report=false", "visual_odometry.enabled=false"]
    run_slam(
        kitti_root,
        "sim",
        weights=tiny_weights,
        output=place / "run",
        frames="0:8",
        overrides=overrides,
    )
    return place


def _write_old_checkpoint(path: Path) -> None:
    tensors = {f"conv{level}.0.weight": torch.ones(4, 3, 3, 3) for level in range(1, 8)}
    torch.save(
        {"epoch": 1, "state_dict": {"conv1.0.weight": torch.ones(16, 3, 7, 7)} | tensors}, path
    )


def _write_euroc(camera: Path, images: list[Path]) -> None:
    (camera / "data").mkdir(parents=True)
    rows = ["#timestamp [ns],filename"]
    for k, path in enumerate(images):
        shutil.copy(path, camera / f"data/{10**18 + k * 10**8}.png")
        rows.append(f"{10**18 + k * 10**8},{10**18 + k * 10**8}.png")
    (camera / "data.csv").write_text("\n".join(rows))
    height, width = cv2.imread(str(images[0])).shape[:2]
    pose = "T_BS:\n  cols: 4\n  rows: 4\n  data: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]\n"
    lens = (
        "camera_model: pinhole\nintrinsics: [60, 60, 47, 31]\ndistortion_model: radial-tangential\n"
    )
    lens += "distortion_coefficients: [0.0, 0.0, 0.0, 0.0]\n"
    (camera / "sensor.yaml").write_text(
        f"sensor_type: camera\n{pose}rate_hz: 10\nresolution: [{width}, {height}]\n{lens}"
    )


@pytest.fixture
def readable(samples: Path, tmp_path: Path, reader: Reader) -> Path:
    """A copy of the sample of a reader, with what belongs to it; it can be read."""
    top, _, rest = reader.file.partition("/")
    if rest:
        shutil.copytree(samples / top, tmp_path / top)
    else:
        shutil.copy(samples / top, tmp_path)
    path = tmp_path / reader.file
    assert reader.name == "checkpoint of SfMLearner" or reader.read(path) is not Ellipsis, (
        "a sample can be read"
    )
    return path


def check_line(line: str, path: Path, place: Path) -> None:
    assert "\n" not in line and len(line) < 1000, line
    assert path.name in line or path.parent.name in line or str(place) in line, line


@pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.name)
def test_a_damaged_file_is_read_or_refused_in_one_line(
    reader: Reader, readable: Path, tmp_path: Path
):
    @FEW
    @given(damaged(readable.read_bytes()))
    def hold(content: bytes) -> None:
        readable.write_bytes(content)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                value = reader.read(readable)
            except (SlamError, ErfsfmError) as error:
                check_line(str(error), readable, tmp_path)
                return
        assert value is None or reader.sound(value)

    hold()


@pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.name)
def test_a_folder_in_the_place_of_a_file_is_refused(reader: Reader, readable: Path, tmp_path: Path):
    readable.unlink()
    readable.mkdir()
    with pytest.raises((SlamError, ErfsfmError)) as raised:
        reader.read(readable)
    check_line(str(raised.value), readable, tmp_path)
