"""Recordings of every layout meet damaged files: they open soundly, or are refused in one line about them.

One row of `FILES` is all that a new layout needs, beside its sample.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from slam.commands.batch.manifest import drives_of
from slam.geometry import se3
from slam.runtime.errors import MissingFrameError
from slam.sequences.catalogue import open_sequence
from slam.sequences.gps import read_gps

FRAMES = 5
WIDTH, HEIGHT = 40, 24
FIRST_NS, STEP_NS = 1403715273262142976, 50_000_000
AHEAD = [0.5, -0.5, 0.5, -0.5]  # wxyz of a camera that looks ahead, in a car's axes
CAMERA_YAML = f"width: {WIDTH}\nheight: {HEIGHT}\nfx: 30\nfy: 30\ncx: 20\ncy: 12\nfps: 5\n"


@dataclass(frozen=True)
class File:
    """A file of a sample, whose first folder is given as the data set."""

    path: str
    read: Callable[[Path], Any]
    sound: Callable[[Any], bool] = lambda value: True


def _walked(path: Path, parts: int, name: str | None = None) -> Any:
    """Open the data set so many parts above a file, and read a frame of it and all scans."""
    sequence = open_sequence(path.parents[parts - 1] if parts else path, name)
    with suppress(MissingFrameError):
        sequence.frame(len(sequence) - 1)
    for k in range(len(sequence)):
        if sequence.has_scan(k):
            assert np.isfinite(sequence.scan(k)).all()
    return sequence


def _is_sequence(sequence: Any) -> bool:
    poses, camera = sequence.reference, sequence.intrinsics
    assert poses is None or se3.is_se3(poses, tolerance=1e-3)
    return bool((np.diff(sequence.stamps) > 0).all() and min(camera.fx, camera.fy) > 0)


def _recording(path: str, parts: int, name: str | None = None) -> File:
    return File(path, lambda file: _walked(file, parts, name), _is_sequence)


def _is_track(track: Any) -> bool:
    return bool(np.isfinite(track.places).all() and (np.diff(track.stamps) > 0).all())


def _drives(path: Path) -> Any:
    return drives_of(path, ["all"], [])


def _are_drives(drives: Any) -> bool:
    names = [drive.name for drive in drives]
    return bool(names) and len(set(names)) == len(names) and all("/" not in name for name in names)


NUSCENES = ("scene", "sample", "sensor", "calibrated_sensor", "ego_pose", "sample_data")
FILES = (
    _recording("folder/times.txt", 1),
    _recording("folder/camera.yaml", 1),
    _recording("euroc/mav0/cam0/data.csv", 3),
    _recording("euroc/mav0/cam0/sensor.yaml", 3),
    _recording("euroc/mav0/state_groundtruth_estimate0/data.csv", 3),
    _recording("tum_mono/times.txt", 1),
    _recording("tum_mono/camera.txt", 1),
    _recording("tum_mono/groundtruthSync.txt", 1),
    _recording("tum/groundtruth.txt", 1),
    _recording("tum/rgb.txt", 1),
    _recording("chess/seq-01/frame-000001.pose.txt", 2),
    _recording("scene0000_00/intrinsic/intrinsic_color.txt", 2),
    _recording("scene0000_00/pose/20.txt", 2),
    *(_recording(f"nuscenes/v1.0-mini/{name}.json", 2, "scene-0061") for name in NUSCENES),
    _recording("nuscenes/samples/LIDAR_TOP/2.pcd.bin", 3, "scene-0061"),
    _recording("walk.bag", 0),
    _recording("walk/walk.mcap", 1),
    _recording("walk/metadata.yaml", 1),
    File("track.csv", read_gps, _is_track),
    File("track.nmea", read_gps, _is_track),
    File("drives.csv", _drives, _are_drives),
)


@pytest.fixture(scope="module")
def samples(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small recording of each layout."""
    place = tmp_path_factory.mktemp("recordings")
    for write in (_folder, _euroc, _tum_mono, _tum, _seven_scenes, _scannet, _nuscenes, _bags, _texts):
        write(place)
    return place


def _images(folder: Path, names: list[str], width: int = WIDTH, height: int = HEIGHT) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for k, name in enumerate(names):
        cv2.imwrite(str(folder / name), np.full((height, width, 3), 10 * k, np.uint8))


def _write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def _folder(place: Path) -> None:
    _images(place / "folder", [f"{k}.png" for k in range(FRAMES)])
    _write(place / "folder/camera.yaml", CAMERA_YAML)
    _write(place / "folder/times.txt", "".join(f"{0.1 * k:.3f}\n" for k in range(FRAMES)))


def _euroc(place: Path) -> None:
    body, stamps = place / "euroc/mav0", [FIRST_NS + k * STEP_NS for k in range(FRAMES)]
    _images(body / "cam0/data", [f"{stamp}.png" for stamp in stamps])
    rows = "".join(f"{stamp},{stamp}.png\r\n" for stamp in stamps)
    _write(body / "cam0/data.csv", "#timestamp [ns],filename\r\n" + rows)
    lens = "distortion_model: radial-tangential\ndistortion_coefficients: [-0.2, 0.05, 0.0, 0.0]\n"
    pose = "T_BS:\n  cols: 4\n  rows: 4\n  data: [0, -1, 0, 0.5, 1, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]\n"
    camera = f"resolution: [{WIDTH}, {HEIGHT}]\ncamera_model: pinhole\nintrinsics: [30, 30, 20, 12]\n"
    _write(body / "cam0/sensor.yaml", f"%YAML:1.0\nsensor_type: camera\n{pose}rate_hz: 20\n{camera}{lens}")
    truth = [f"{stamp},7,{k},3,1,0,0,0,0.1,0.1,0.1\n" for k, stamp in enumerate(stamps)]
    _write(body / "state_groundtruth_estimate0/data.csv", "#timestamp, p_RS_R_x [m], ...\n" + "".join(truth))


def _tum_mono(place: Path) -> None:
    folder = place / "tum_mono"
    _images(folder / "images", [f"{k:05d}.jpg" for k in range(FRAMES)])
    _write(folder / "times.txt", "".join(f"{k:05d} {100 + 0.05 * k:.6f} 3.5\n" for k in range(FRAMES)))
    _write(folder / "camera.txt", f"0.5 0.8 0.5 0.5 0.9\n{WIDTH} {HEIGHT}\ncrop\n{WIDTH} {HEIGHT}\n")
    rows = [f"{100 + 0.05 * k:.6f} 0 0 {k} 0 0 0 1\n" for k in range(FRAMES)]
    _write(folder / "groundtruthSync.txt", "".join(rows))


def _tum(place: Path) -> None:
    _images(place / "tum/rgb", [f"{k}.png" for k in range(FRAMES)])
    _write(place / "tum/camera.yaml", CAMERA_YAML)
    _write(place / "tum/rgb.txt", "# stamps\n" + "".join(f"{k / 10} rgb/{k}.png\n" for k in range(FRAMES)))
    _write(place / "tum/groundtruth.txt", "".join(f"{k / 10} 0 0 {k} 0 0 0 1\n" for k in range(FRAMES)))


def _seven_scenes(place: Path) -> None:
    folder = place / "chess/seq-01"
    _images(folder, [f"frame-{k:06d}.color.png" for k in range(2)], 640, 480)
    for k in range(2):
        _write(folder / f"frame-{k:06d}.pose.txt", f"0 0 1 0\n0 1 0 2\n-1 0 0 {k}\n0 0 0 1\n")


def _scannet(place: Path) -> None:
    folder = place / "scene0000_00"
    _images(folder / "color", [f"{k}.jpg" for k in (20, 30, 40)])
    for k in (20, 30, 40):
        _write(folder / f"pose/{k}.txt", f"0 0 1 1\n0 1 0 2\n-1 0 0 {k}\n0 0 0 1\n")
    _write(folder / "intrinsic/intrinsic_color.txt", "30 0 20 0\n0 31 12 0\n0 0 1 0\n0 0 0 1\n")


def _nuscenes(place: Path) -> None:
    root = place / "nuscenes"
    _images(root / "samples/CAM_FRONT", [f"{k}.jpg" for k in range(FRAMES)])
    (root / "samples/LIDAR_TOP").mkdir(parents=True)
    np.arange(10, dtype=np.float32).tofile(root / "samples/LIDAR_TOP/2.pcd.bin")
    data: list[dict[str, Any]] = []
    for k in range(FRAMES):
        row = {"sample_token": "s0", "ego_pose_token": f"e{k}", "timestamp": 10**15 + 80_000 * k}
        size = {"calibrated_sensor_token": "cam", "width": WIDTH, "height": HEIGHT}
        data.append(row | size | {"filename": f"samples/CAM_FRONT/{k}.jpg"})
    data.append(data[2] | {"calibrated_sensor_token": "lidar", "filename": "samples/LIDAR_TOP/2.pcd.bin"})
    lidar = {"token": "lidar", "sensor_token": "l", "translation": [0.9, 0, 1.8], "rotation": [1, 0, 0, 0]}
    K = [[30, 0, 20], [0, 30, 12], [0, 0, 1]]
    camera = {"token": "cam", "sensor_token": "c", "translation": [1.7, 0, 1.5], "rotation": AHEAD}
    tables: dict[str, list[dict[str, Any]]] = {
        "scene": [{"token": "a", "name": "scene-0061"}],
        "sample": [{"token": "s0", "scene_token": "a"}],
        "sensor": [{"token": "c", "channel": "CAM_FRONT"}, {"token": "l", "channel": "LIDAR_TOP"}],
        "calibrated_sensor": [camera | {"camera_intrinsic": K}, lidar | {"camera_intrinsic": []}],
        "ego_pose": [{"token": f"e{k}", "translation": [k, 5, 0], "rotation": [1, 0, 0, 0]} for k in range(FRAMES)],
        "sample_data": data,
    }
    for name, rows in tables.items():
        _write(root / f"v1.0-mini/{name}.json", json.dumps(rows))


def _bags(place: Path) -> None:
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    modern = Writer2(place / "walk", version=9, storage_plugin=StoragePlugin.MCAP)
    for writer, store in ((Writer1(place / "walk.bag"), Stores.ROS1_NOETIC), (modern, Stores.ROS2_HUMBLE)):
        types, is_ros1 = get_typestore(store), store is Stores.ROS1_NOETIC
        serialise = types.serialize_ros1 if is_ros1 else types.serialize_cdr
        with writer:
            topic = writer.add_connection("/camera/image", "sensor_msgs/msg/Image", typestore=types)
            about = writer.add_connection("/camera/camera_info", "sensor_msgs/msg/CameraInfo", typestore=types)
            for k in range(FRAMES):
                header = _header(types.types, FIRST_NS + k * STEP_NS, is_ros1)
                image = _image(types.types, header, k)
                info = _camera_info(types.types, header, is_ros1)
                writer.write(topic, FIRST_NS + k * STEP_NS, serialise(image, image.__msgtype__))
                writer.write(about, FIRST_NS + k * STEP_NS, serialise(info, info.__msgtype__))


def _header(types: Any, stamp_ns: int, is_ros1: bool) -> Any:
    stamp = types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    return types["std_msgs/msg/Header"](**({"seq": 0} if is_ros1 else {}), stamp=stamp, frame_id="camera")


def _image(types: Any, header: Any, k: int) -> Any:
    size = {"height": HEIGHT, "width": WIDTH, "step": WIDTH, "is_bigendian": 0}
    data = np.full(HEIGHT * WIDTH, 10 * k, np.uint8)
    return types["sensor_msgs/msg/Image"](header=header, encoding="mono8", data=data, **size)


def _camera_info(types: Any, header: Any, is_ros1: bool) -> Any:
    K = np.array([30, 0, 20, 0, 30, 12, 0, 0, 1], np.float64)
    P = np.insert(K.reshape(3, 3), 3, 0, axis=1).ravel()
    values = {"d": np.zeros(5), "k": K, "r": np.eye(3).ravel(), "p": P}
    whole = types["sensor_msgs/msg/RegionOfInterest"](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    named = {key.upper() if is_ros1 else key: value for key, value in values.items()}
    size = {"height": HEIGHT, "width": WIDTH, "binning_x": 0, "binning_y": 0}
    return types["sensor_msgs/msg/CameraInfo"](header=header, distortion_model="plumb_bob", roi=whole, **size, **named)


def _texts(place: Path) -> None:
    fixes = "".join(f"{k}.0,49.0000{k},8.4,115\n" for k in range(4))
    _write(place / "track.csv", "stamp, latitude, longitude, altitude\n" + fixes)
    fix = "$GPGGA,12351{k},4807.03{k},N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,\n"
    _write(place / "track.nmea", "".join(fix.format(k=k) for k in range(4)))
    _write(place / "drives.csv", "name,dataset,options\none,a,--frames 0:9\ntwo,b,\n")


@pytest.fixture
def readable(samples: Path, tmp_path: Path, file: File) -> Path:
    """A copy of a sample, which is sound."""
    top = file.path.partition("/")[0]
    if (samples / top).is_dir():
        shutil.copytree(samples / top, tmp_path / top)
    else:
        shutil.copy(samples / top, tmp_path)
    path = tmp_path / file.path
    assert file.sound(file.read(path)), "a sample can be read"
    return path


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.path)
def test_a_damaged_recording_is_read_or_refused_in_one_line(
    file: File, readable: Path, damage_file: Callable[..., None]
) -> None:
    damage_file(readable, file.read, file.sound, many=False)


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.path)
def test_a_folder_in_the_place_of_a_file_is_refused(
    file: File, readable: Path, refuse_folder: Callable[..., None]
) -> None:
    refuse_folder(readable, file.read)


@pytest.mark.slow
@pytest.mark.parametrize("file", FILES, ids=lambda file: file.path)
def test_many_damaged_recordings(file: File, readable: Path, damage_file: Callable[..., None]) -> None:
    damage_file(readable, file.read, file.sound, many=True)
