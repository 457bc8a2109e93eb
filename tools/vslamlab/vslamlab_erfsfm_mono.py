"""Run erfsfm-slam on a sequence of VSLAM-LAB and write its trajectory there; `baseline_erfsfm.py` says with what.

Example: python tools/vslamlab/vslamlab_erfsfm_mono.py --sequence_path SEQUENCE --calibration_yaml
SEQUENCE/calibration.yaml --rgb_csv SEQUENCE/rgb.csv --exp_folder EXPERIMENT
"""

from __future__ import annotations

import argparse
import csv
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml
from scipy.spatial.transform import Rotation

from erfsfm.common.errors import OneLineError
from slam import run_slam

CAMERA = "rgb_0"
MODELS = {"radtan4": "opencv", "radtan5": "opencv", "equid4": "fisheye"}
HEAD = ["ts (ns)", "tx (m)", "ty (m)", "tz (m)", "qx", "qy", "qz", "qw"]


def main(words: Sequence[str] | None = None) -> None:
    """Make a folder that our system reads, run it, and write every pose."""
    options = _options(words)
    number = f"{int(options.exp_it):05d}"
    place = options.exp_folder.resolve() / f"{number}_erfsfm"
    shutil.rmtree(place, ignore_errors=True)
    try:
        stamps_ns = _write_recording(options, place / "images")
        run = run_slam(
            place / "images",
            output=place / "run",
            weights=options.weights,
            seed=int(options.exp_it),
            overrides=["output.report=false", *options.overrides.split()],
        )
        trajectory = run.trajectory("optimised")
        if trajectory is None:
            raise SystemExit(f"{run.path} has no trajectory: {run.metrics().failure}")
    except OneLineError as error:
        raise SystemExit(str(error)) from error
    quaternions_xyzw = Rotation.from_matrix(trajectory.T_world_camera[:, :3, :3]).as_quat()
    with (options.exp_folder / f"{number}_KeyFrameTrajectory.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(HEAD)
        for stamp, position, quaternion in zip(stamps_ns, trajectory.positions, quaternions_xyzw, strict=True):
            writer.writerow([stamp, *position, *quaternion])


def _write_recording(options: argparse.Namespace, folder: Path) -> list[int]:
    """Links to the images, ``times.txt`` and ``camera.yaml``; the stamps in nanoseconds."""
    with options.rgb_csv.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    folder.mkdir(parents=True)
    stamps_ns = [int(row[f"ts_{CAMERA} (ns)"]) for row in rows]
    for index, row in enumerate(rows):
        image = (options.sequence_path / row[f"path_{CAMERA}"]).resolve()
        (folder / f"{index:06d}{image.suffix}").symlink_to(image)
    times = [f"{(stamp - stamps_ns[0]) / 1e9:.9f}\n" for stamp in stamps_ns]
    (folder / "times.txt").write_text("".join(times))
    cameras = yaml.safe_load(options.calibration_yaml.read_text(encoding="utf-8"))["cameras"]
    camera = _camera(next(each for each in cameras if each["cam_name"] == CAMERA), options.camera_height_m)
    (folder / "camera.yaml").write_text(yaml.safe_dump(camera))
    return stamps_ns


def _camera(theirs: dict[str, Any], height_m: str) -> dict[str, Any]:
    """``camera.yaml`` of one of VSLAM-LAB's cameras."""
    if theirs["cam_model"] != "pinhole":
        raise SystemExit(f"the camera model {theirs['cam_model']} is not known here: calibrate it as pinhole")
    (width, height), (fx, fy), (cx, cy) = (
        theirs[key] for key in ("image_dimension", "focal_length", "principal_point")
    )
    camera = {"width": width, "height": height, "fx": fx, "fy": fy, "cx": cx, "cy": cy, "fps": theirs["fps"]}
    camera["camera_height_m"] = height_m if height_m == "unknown" else float(height_m)
    kind = theirs.get("distortion_type")
    if kind is None:
        return camera | {"model": "pinhole"}
    if kind not in MODELS:
        raise SystemExit(f"the distortion {kind} is not known here, only {', '.join(MODELS)}")
    return camera | {"model": MODELS[kind], "distortion": theirs["distortion_coefficients"]}


def _options(words: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("sequence_path", "calibration_yaml", "rgb_csv", "exp_folder"):
        parser.add_argument(f"--{name}", type=Path, required=True)
    parser.add_argument("--exp_it", default="0", help="number of the run, which is its seed, too")
    parser.add_argument("--weights", default="sim")
    parser.add_argument("--camera_height_m", default="unknown", help="of the camera above the road")
    parser.add_argument("--overrides", default="", help="settings, divided by blanks")
    return parser.parse_known_args(words)[0]


if __name__ == "__main__":
    main()
