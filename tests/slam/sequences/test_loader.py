from __future__ import annotations

import re
import struct
import sys
from collections.abc import Callable, Iterator
from fractions import Fraction
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from erfsfm.common.errors import DataError
from erfsfm.common.readers.images import list_images
from erfsfm.common.readers.numbering import by_name
from erfsfm.common.readers.video import VideoFrames
from slam.commands.doctor import examine
from slam.config.sections import load_config
from slam.frames import Frame, Intrinsics
from slam.prediction.assembly import open_depth
from slam.runtime.errors import ConfigError, MissingFrameError, SequenceError
from slam.runtime.imports import plug_ins
from slam.sequences import loader
from slam.sequences.catalogue import open_sequence
from slam.sequences.images import ImageFiles

UNEVEN = [0, 20, 40, 100, 120, 140, 160, 220, 240, 260]
DOCS = Path(__file__).parents[3] / "docs"


@pytest.mark.parametrize(
    ("inner", "beside", "suffix"),
    [("", False, ".png"), ("images", True, ".jpg"), ("data", False, ".jpeg"), ("", True, ".bmp")],
)
def test_layouts(tmp_path: Path, images, camera_yaml: str, inner: str, beside: bool, suffix: str):
    folder = tmp_path / "drive"
    images(folder / inner, [f"f{k}{suffix}" for k in range(12)])
    ((tmp_path if beside else folder) / "camera.yaml").write_text(camera_yaml)
    (folder / "ins.txt").write_text("ignored")
    sequence = open_sequence(folder)
    assert (sequence.name, len(sequence)) == ("drive", 12)
    assert sequence.frame(11).image[0, 0, 0] == pytest.approx(110, abs=2)
    assert sequence.stamps == pytest.approx(np.arange(12) / 5)
    assert sequence.reference is None and sequence.camera_height_m is None
    assert sequence.provenance() == ("folder/drive[0:12]",)


def test_inner_folder_has_the_outer_name(tmp_path: Path, images, camera_yaml: str):
    images(tmp_path / "drive" / "images", ["0.png", "1.png"])
    (tmp_path / "drive" / "camera.yaml").write_text(camera_yaml + "camera_height_m: 1.4\n")
    sequence = open_sequence(tmp_path / "drive" / "images", None, None, "1:")
    assert sequence.name == "drive" and sequence.camera_height_m == 1.4
    assert sequence.provenance() == ("folder/drive[1:2]",)


def test_undistorts(tmp_path: Path, images, camera_yaml: str):
    images(tmp_path, ["0.png", "1.png"])
    (tmp_path / "camera.yaml").write_text(
        camera_yaml + "model: opencv\ndistortion: [-0.2, 0, 0, 0]\n"
    )
    sequence = open_sequence(tmp_path)
    assert sequence.intrinsics.fx < 30 and (sequence.frame(1).image == 10).all()


def test_a_gap_in_the_numbers_is_a_gap_in_time(
    tmp_path: Path, images, camera_yaml: str, caplog: pytest.LogCaptureFixture
):
    images(tmp_path, ["f17.png", "f18.png", "f21.png", "f22.png"])
    (tmp_path / "camera.yaml").write_text(camera_yaml)
    sequence = open_sequence(tmp_path)
    assert len(sequence) == 6
    assert sequence.stamps == pytest.approx(np.arange(6) / 5)
    assert [sequence.frame(index).image[0, 0, 0] for index in (0, 1, 4, 5)] == [0, 10, 20, 30]
    for index, name in ((2, "f19"), (3, "f20")):
        with pytest.raises(MissingFrameError, match=rf"no image {name}\.png in "):
            sequence.frame(index)
    (warning,) = caplog.records
    assert (
        "2 of 6 frames have no image; the first gap is f19.png to f20.png" in warning.getMessage()
    )
    with pytest.raises(MissingFrameError):
        open_sequence(tmp_path, frames="1:4").frame(1)


@pytest.mark.parametrize(
    "fps, last", [(50, 202), (5, 60), (50, 10**15)], ids=["frames", "seconds", "for ever"]
)
def test_a_long_gap_is_refused(tmp_path: Path, images, camera_yaml: str, fps: int, last: int):
    images(tmp_path, [f"{k}.png" for k in range(5)] + [f"{last}.png"])
    (tmp_path / "camera.yaml").write_text(camera_yaml.replace("fps: 5", f"fps: {fps}"))
    with pytest.raises(
        SequenceError, match=rf"no images 5\.png to {last - 1}\.png .*split the recording"
    ) as caught:
        open_sequence(tmp_path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("step", ["1e8", "1e-9", "nan"])
def test_stamps_that_cannot_be_seconds_are_refused(
    tmp_path: Path, images, camera_yaml: str, step: str
):
    images(tmp_path, [f"{k}.png" for k in range(4)])
    (tmp_path / "camera.yaml").write_text(camera_yaml)
    (tmp_path / "times.txt").write_text("".join(f"{k * float(step):.12f}\n" for k in range(4)))
    with pytest.raises(SequenceError, match=r"s apart: check its stamps|not a time in seconds"):
        open_sequence(tmp_path)


@pytest.mark.parametrize("form", ["{}.{:06d}.png", "{}{:06d}000.png", "left_{}{:06d}.png"])
def test_names_that_are_times(tmp_path: Path, images, camera_yaml: str, form: str):
    microseconds = [900_000, 933_333, 1_200_000]
    images(
        tmp_path, [form.format(1403715273 + each // 10**6, each % 10**6) for each in microseconds]
    )
    (tmp_path / "camera.yaml").write_text(camera_yaml)
    assert np.diff(open_sequence(tmp_path).stamps) == pytest.approx(
        np.diff(microseconds) / 1e6, abs=1e-6
    )


@pytest.mark.parametrize(
    ("name", "rows"),
    [
        ("times.txt", "0 10.0\n1 10.1\n2 10.3\n"),
        (
            "timestamps.csv",
            "name,time\n0.png,1403715273000000000\n1.png,1403715273100000000\n2.png,1403715273300000000\n",
        ),
        ("timestamps.txt", "1403715273000\n1403715273100\n1403715273300\n"),
    ],
)
def test_tables_of_times(tmp_path: Path, images, camera_yaml: str, name: str, rows: str):
    images(tmp_path, ["0.png", "1.png", "2.png"])
    (tmp_path / "camera.yaml").write_text(camera_yaml)
    (tmp_path / name).write_text(rows)
    assert np.diff(open_sequence(tmp_path).stamps) == pytest.approx([0.1, 0.2], abs=1e-6)


def test_a_table_of_times_cut_to_match_as_advised(tmp_path: Path, images, camera_yaml: str):
    images(tmp_path, ["0.png", "1.png"])
    (tmp_path / "camera.yaml").write_text(camera_yaml)
    times = ["0.0", "0.1", "0.2", "0.3"]
    (tmp_path / "times.txt").write_text("\n".join(times))
    with pytest.raises(SequenceError, match="cut the file to match"):
        open_sequence(tmp_path)
    (tmp_path / "times.txt").write_text("\n".join(times[:2]))
    assert len(open_sequence(tmp_path)) == 2


def test_times_beside_the_folder_of_images_that_is_named(tmp_path: Path, images, camera_yaml: str):
    (tmp_path / "images").mkdir()
    images(tmp_path / "images", ["0.png", "1.png"])
    (tmp_path / "camera.yaml").write_text(camera_yaml)
    (tmp_path / "times.txt").write_text("5.0\n5.3\n")
    assert open_sequence(tmp_path / "images").stamps.tolist() == [5.0, 5.3]


def test_a_camera_of_another_size_scaled_as_advised(tmp_path: Path, images, camera_yaml: str):
    images(tmp_path, ["0.png", "1.png"])
    path = tmp_path / "camera.yaml"
    keys = yaml.safe_load(camera_yaml)
    path.write_text(
        yaml.safe_dump({**keys, "width": 2 * keys["width"], "height": 2 * keys["height"]})
    )
    with pytest.raises(SequenceError, match=r"scale the file to \{(.*)\}") as caught:
        open_sequence(tmp_path)
    path.write_text(
        yaml.safe_dump(keys | yaml.safe_load("{" + str(caught.value).rpartition("{")[2]))
    )
    assert open_sequence(tmp_path).intrinsics.fx == pytest.approx(keys["fx"] / 2)


def test_the_first_readable_image_gives_the_size_and_another_is_named(tmp_path: Path, images):
    images(tmp_path, ["0.png", "1.png", "3.png"])
    images(tmp_path, ["2.png"], width=41)
    (tmp_path / "0.png").write_bytes(b"")
    files = ImageFiles(by_name(list_images(tmp_path)))
    assert (files.width, files.height, len(files)) == (40, 24, 4) and files.read(1)[0, 0, 0] == 10
    with pytest.raises(DataError, match=r"0\.png is empty"):
        files.read(0)
    with pytest.raises(SequenceError, match=r"2\.png is 41x24, but 1\.png is 40x24"):
        files.read(2)


def write_video(path: Path) -> Path:
    """Ninety black frames but for number 12, which is white."""
    path.parent.mkdir(parents=True, exist_ok=True)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10, (64, 48))
    for k in range(90):
        writer.write(np.full((48, 64, 3), 255 * (k == 12), np.uint8))
    writer.release()
    return path


@pytest.fixture
def camera_64(camera_yaml: str) -> str:
    return camera_yaml.replace("width: 40", "width: 64").replace("height: 24", "height: 48")


@pytest.mark.parametrize("by_folder", [False, True])
def test_opens(tmp_path: Path, camera_64: str, by_folder: bool):
    path = write_video(tmp_path / "trip" / "drive.avi")
    (tmp_path / "trip" / "camera.yaml").write_text(camera_64)
    (tmp_path / "trip" / "._drive.avi").write_bytes(b"what macOS keeps beside a file")
    sequence = open_sequence(tmp_path / "trip" if by_folder else path, None, None, "10:20")
    assert (sequence.name, len(sequence)) == ("drive", 10)
    assert [bool(sequence.frame(k).image.mean() > 200) for k in range(1, 4)] == [False, True, False]
    assert sequence.stamps[0] == pytest.approx(2.0)
    assert sequence.provenance() == ("folder/trip[10:20]",)


def write_mp4(
    path: Path, times: list[int], rate: int = 30, rotated: bool = False, aspect: str = "1"
) -> Path:
    """Grey frames of 64x48 shown at ``times``, in units of 1/600 s; the left half of each is white."""
    av = pytest.importorskip("av")
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=rate, options={"bf": "0"})
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        stream.codec_context.time_base = Fraction(1, 600)
        stream.codec_context.sample_aspect_ratio = Fraction(aspect)
        for time in times:
            picture = np.full((48, 64, 3), 90, np.uint8)
            picture[:, :32] = 255
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            frame.pts, frame.time_base = time, Fraction(1, 600)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    if rotated:
        turned = struct.pack(">9i", 0, 1 << 16, 0, -(1 << 16), 0, 0, 48 << 16, 0, 1 << 30)
        straight = struct.pack(">9i", 1 << 16, 0, 0, 0, 1 << 16, 0, 0, 0, 1 << 30)
        data = path.read_bytes()
        header = data.index(b"tkhd")
        assert straight in data[header:]
        path.write_bytes(data[:header] + data[header:].replace(straight, turned, 1))
    return path


@pytest.mark.parametrize(("rotated", "ratio"), [(False, 4 / 3), (True, 3 / 4)])
def test_pixels_of_a_video_that_are_not_square(tmp_path: Path, rotated: bool, ratio: float):
    path = write_mp4(tmp_path / "a.mp4", [0, 60, 120, 180], rotated=rotated, aspect="4/3")
    camera = open_sequence(path, camera=Path("fov=70")).intrinsics
    assert camera.fy / camera.fx == pytest.approx(ratio)
    assert camera.width == (48 if rotated else 64)


def test_uneven_frame_times_are_used(
    tmp_path: Path, camera_64: str, caplog: pytest.LogCaptureFixture
):
    path = write_mp4(tmp_path / "phone.mp4", UNEVEN)
    camera = tmp_path / "camera.yaml"
    camera.write_text(camera_64.replace("fps: 5", "fps: 20"))
    assert open_sequence(path).stamps == pytest.approx(np.array(UNEVEN) / 600)
    camera.write_text(camera_64)
    assert open_sequence(path).stamps == pytest.approx(np.arange(10) / 5)
    assert (
        "has 20.77 frames a second, the camera has 5: taken as even at the camera's rate"
        in caplog.text
    )


def test_missing_frames_do_not_change_the_rate(tmp_path: Path, camera_64: str):
    times = [60 * k for k in range(60) if k % 7 and not 30 <= k < 35]
    path = write_mp4(tmp_path / "drive.mp4", times)
    (tmp_path / "camera.yaml").write_text(camera_64.replace("fps: 5", "fps: 10"))
    assert open_sequence(path).stamps == pytest.approx((np.array(times) - times[0]) / 600)


def test_even_frames_have_the_rate_of_the_video(
    tmp_path: Path, camera_64: str, caplog: pytest.LogCaptureFixture
):
    path = write_mp4(tmp_path / "phone.mp4", [120 * k for k in range(12)])
    camera = tmp_path / "camera.yaml"
    for fps, stamps in (
        ("5.02", np.arange(12) / 5.02),
        ("5.4", np.arange(12) / 5),
        ("10", np.arange(12) / 10),
    ):
        assert "frames a second" not in caplog.text
        camera.write_text(camera_64.replace("fps: 5", f"fps: {fps}"))
        assert open_sequence(path).stamps == pytest.approx(stamps, abs=1e-9), fps
    assert (
        "phone.mp4 has 5 frames a second, the camera has 10: taken as even at the camera's rate"
        in caplog.text
    )


def test_a_field_of_view_takes_the_rate_of_the_video(tmp_path: Path):
    path = write_mp4(tmp_path / "phone.mp4", [24 * k for k in range(8)])
    sequence = open_sequence(path, camera=Path("fov=90"))
    assert sequence.intrinsics.fx == pytest.approx(32)
    assert sequence.stamps == pytest.approx(np.arange(8) / 25)


@pytest.mark.parametrize("suffix", [".mp4", ".mkv"])
def test_frames_and_times_of_a_long_video_are_those_of_its_packets(
    tmp_path: Path, suffix: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    """An mkv announces a guess: its duration times a rate."""
    path = write_mp4(tmp_path / f"long{suffix}", UNEVEN)
    monkeypatch.setattr(loader, "VideoFrames", partial(VideoFrames, counted_frames=4))
    sequence = open_sequence(path, camera=Path("fov=70"))
    assert sequence.stamps == pytest.approx(np.array(UNEVEN) / 600, abs=5e-4)
    assert ("announces 14 frames and has 10" in caplog.text) == (suffix == ".mkv")


def test_a_rotation_flag_turns_the_images(tmp_path: Path):
    """A phone held upright stores lying images and a flag: 90 degrees, so that left becomes top."""
    path = write_mp4(tmp_path / "upright.mp4", [20 * k for k in range(4)], rotated=True)
    sequence = open_sequence(path, camera=Path("fov=60"))
    assert (sequence.intrinsics.width, sequence.intrinsics.height) == (48, 64)
    image = sequence.frame(2).image
    assert image[:28].mean() > 200 and image[36:].mean() < 130


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[Path], str]]:
    """Makes a package of the code and the entry point of a page; returns its code."""

    def package(page: Path) -> str:
        text = page.read_text(encoding="utf-8")
        (entry_point,) = re.findall(
            r"```toml\n\[project\.entry-points\.\"(.*?)\"\]\n(.*?)```", text, re.DOTALL
        )
        group, (module,) = entry_point[0], re.findall(r"\"(.*?):", entry_point[1])
        code = text.partition(entry_point[1])[2].partition("```python\n")[2].partition("```")[0]
        (tmp_path / "site" / f"{module}-1.dist-info").mkdir(parents=True)
        (tmp_path / "site" / f"{module}.py").write_text(code)
        (tmp_path / "site" / f"{module}-1.dist-info" / "METADATA").write_text(
            f"Name: {module}\nVersion: 1\n"
        )
        quoted = entry_point[1].replace('"', "")
        (tmp_path / "site" / f"{module}-1.dist-info" / "entry_points.txt").write_text(
            f"[{group}]\n{quoted}"
        )
        monkeypatch.syspath_prepend(tmp_path / "site")
        monkeypatch.delitem(sys.modules, module, raising=False)
        plug_ins.cache_clear()
        return code

    yield package
    plug_ins.cache_clear()


def test_the_example_is_a_loader(
    tmp_path: Path, images, camera_yaml: str, install: Callable[[Path], str]
):
    code = install(DOCS / "design" / "loaders.md")
    assert (
        len(
            [
                line
                for line in code.splitlines()
                if line and not line.startswith(("import", "from", '"""'))
            ]
        )
        <= 30
    )
    drive = tmp_path / "monday"
    images(drive / "left", [f"{k}.png" for k in range(4)])
    (drive / "left/1.png").unlink()
    (drive / "drive.csv").write_text(
        "".join(f"left/{k}.png,{10 + 0.1 * k},0,0,{k},0,0,0,1\n" for k in range(4))
    )
    (drive / "camera.yaml").write_text(camera_yaml)
    sequence = open_sequence(drive)
    assert sequence.stamps == pytest.approx([10, 10.1, 10.2, 10.3])
    assert sequence.reference is not None and sequence.reference[:, 2, 3] == pytest.approx(
        np.arange(4)
    )
    assert sequence.frame(2).image[0, 0, 0] == 20
    with pytest.raises(MissingFrameError, match=r"no image 1\.png"):
        sequence.frame(1)
    line = examine(drive)[-1]
    assert line.startswith(
        "ok       sequence monday: 4 frames of 40x24, true poses"
    ) and line.endswith("(our drives)")


def test_the_example_is_a_source_of_depth(install: Callable[[Path], str]):
    with pytest.raises(ConfigError, match=r"network, onnx:FILE, npy:FOLDER or png:FOLDER"):
        load_config(None, ["depth.source=flat:2.5"])
    install(DOCS / "depth.md")
    depth = load_config(None, ["depth.source=flat:2.5"]).depth
    source = open_depth(depth, Intrinsics(40, 24, 30.0, 30.0, 19.5, 11.5), None)
    assert source is not None and len(source.sha256) == 64
    disparity = source.disparity(Frame(0, 0.0, np.zeros((24, 40, 3), np.uint8)))
    np.testing.assert_allclose(disparity, np.full((24, 40), 0.4), rtol=1e-6)
