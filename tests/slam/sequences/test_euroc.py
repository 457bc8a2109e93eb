"""EuRoC's layout: distorted images, stamps in nanoseconds, true poses of the body, rows without an image."""

import logging
from pathlib import Path

import numpy as np
import pytest

from slam.runtime.errors import MissingFrameError, SequenceError
from slam.sequences.catalogue import open_sequence

FIRST_NS, STEP_NS, FRAMES = 1403715273262142976, 50_000_000, 6
SENSOR = """%YAML:1.0
sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: [0.0, -1.0, 0.0, 0.5,
         1.0, 0.0, 0.0, 0.0,
         0.0, 0.0, 1.0, 0.0,
         0.0, 0.0, 0.0, 1.0]
rate_hz: 20
resolution: [40, 24]
camera_model: pinhole
intrinsics: [30, 30, 20, 12] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.2, 0.05, 0.0, 0.0]
"""


@pytest.fixture
def flight(tmp_path: Path, images) -> Path:
    """Six frames; the body goes 1 m along its y axis a frame, without turning."""
    body = tmp_path / "MH_07/mav0"
    stamps = [FIRST_NS + k * STEP_NS for k in range(FRAMES)]
    images(body / "cam0/data", [f"{stamp}.png" for stamp in stamps])
    rows = "".join(f"{stamp},{stamp}.png\r\n" for stamp in stamps)
    (body / "cam0/data.csv").write_text("#timestamp [ns],filename\r\n" + rows, newline="")
    (body / "cam0/sensor.yaml").write_text(SENSOR)
    return body


def write_truth(body: Path, first: int, stop: int) -> None:
    folder = body / "state_groundtruth_estimate0"
    folder.mkdir()
    rows = [f"{FIRST_NS + k * STEP_NS},7,{k},3,1,0,0,0,0.1,0.1,0.1\n" for k in range(first, stop)]
    (folder / "data.csv").write_text("#timestamp, p_RS_R_x [m], ...\n" + "".join(rows))


@pytest.mark.parametrize("given", [".", "..", "../.."])
def test_opens(flight: Path, given: str) -> None:
    write_truth(flight, 0, FRAMES)
    sequence = open_sequence((flight / given).resolve())
    assert (sequence.name, len(sequence), sequence.camera_height_m) == ("MH_07", FRAMES, None)
    assert sequence.stamps[1] == (FIRST_NS + STEP_NS) / 10**9
    assert sequence.provenance() == ("euroc/MH_07[0:6]",)
    assert sequence.intrinsics.fx != 30 and sequence.frame(3).image.shape == (24, 40, 3)
    # the camera is turned by 90 degrees about the body's z: its x axis is the body's y
    assert sequence.reference is not None
    assert sequence.reference[:, :3, 3] == pytest.approx(np.outer(np.arange(FRAMES), [1, 0, 0]), abs=1e-6)


def test_true_poses_of_some_frames_are_those_of_an_excerpt(flight: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_truth(flight, 3, FRAMES)
    with caplog.at_level(logging.WARNING):
        assert open_sequence(flight).reference is None
    assert "no pose of image 0" in caplog.text and "frames 1:6 have one each" in caplog.text
    excerpt = open_sequence(flight, frames="3:6").reference
    assert excerpt is not None and excerpt[:, 0, 3] == pytest.approx([0, 1, 2])


def test_rows_without_an_image_are_gaps(flight: Path) -> None:
    for k in (0, 3):
        (flight / f"cam0/data/{FIRST_NS + k * STEP_NS}.png").unlink()
    sequence = open_sequence(flight)
    assert len(sequence) == 5 and sequence.stamps[0] == (FIRST_NS + STEP_NS) / 10**9
    assert sequence.frame(1).image[0, 0, 0] == 20
    with pytest.raises(MissingFrameError, match=rf"no image {FIRST_NS + 3 * STEP_NS}\.png"):
        sequence.frame(2)


def test_a_camera_file_replaces_the_calibration_and_one_beside_gives_the_height(
    flight: Path, tmp_path: Path, camera_yaml: str, caplog: pytest.LogCaptureFixture
) -> None:
    given = tmp_path / "mine.yaml"
    given.write_text(camera_yaml)
    sensor = flight / "cam0/sensor.yaml"
    sensor.write_text(SENSOR.replace("radial-tangential", "omni"))  # a lens that is not known
    assert open_sequence(flight, camera=given).intrinsics.fx == 30
    sensor.unlink()
    write_truth(flight, 0, FRAMES)
    sequence = open_sequence(flight, camera=given)
    assert sequence.intrinsics.fx == 30 and sequence.reference is None
    assert "sensor.yaml, which says where" in caplog.text
    sensor.write_text(SENSOR)
    (flight.parent / "camera.yaml").write_text(camera_yaml + "camera_height_m: 1.2\n")
    sequence = open_sequence(flight)
    assert sequence.camera_height_m == 1.2 and sequence.intrinsics.fx != 30


@pytest.mark.parametrize(
    "name, old, new, message",
    [
        ("sensor.yaml", "radial-tangential", "omni", "omni is unknown: known are .*give --camera"),
        ("sensor.yaml", "resolution:", "size:", "lacks .resolution"),
        ("sensor.yaml", "T_BS", "T_SB", "needs T_BS with data of 4 x 4 numbers"),
        ("sensor.yaml", "rate_hz: 20", "rate_hz: !!python/object/apply:os.getcwd []", "could not determine"),
    ],
)
def test_damage(flight: Path, name: str, old: str, new: str, message: str) -> None:
    path = flight / "cam0" / name
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new, 1))
    write_truth(flight, 0, FRAMES)
    with pytest.raises(SequenceError, match=message) as caught:
        open_sequence(flight)
    assert "\n" not in str(caught.value)


@pytest.mark.data
def test_the_real_sample(data_root: Path) -> None:
    sequence = open_sequence(data_root / "euroc_micro")
    assert (sequence.name, len(sequence)) == ("euroc_micro", 95)
    assert np.diff(sequence.stamps) == pytest.approx(0.05, abs=1e-4)
    K = sequence.intrinsics
    assert (K.width, K.height, K.cx, K.cy) == (752, 480, 367.215, 248.375)
    assert sequence.frame(94).image.std() > 20
