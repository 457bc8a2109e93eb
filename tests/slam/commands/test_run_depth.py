"""Whole runs with depth from elsewhere: another network, arrays, pictures; and what is refused."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

import slam.commands.cli
from slam import Slam, run_slam
from slam.commands.localisation import localise
from slam.config.sections import DepthConfig, load_config
from slam.prediction.depth_source import DepthFolder, FrameNumbers
from slam.results.folder import RunFolder
from slam.runtime.errors import SlamError
from slam.sequences.catalogue import open_sequence
from slam.simulation.kitti_layout import write_kitti_root
from slam.simulation.options import SimulationOptions
from slam.simulation.street import SimulatedStreet

CheckRun = Callable[[Path], dict[str, Any]]
FRAMES = 18
PLAIN = ["output.report=false", "mapping.enabled=false"]
COARSE_MAP = ["mapping.enabled=true", "mapping.voxel_size_m=0.5", "depth.refine=none"]


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """18 frames of a simulated street, with exact depth as pictures. Not to be changed."""
    root = tmp_path_factory.mktemp("depth") / "world"
    options = SimulationOptions(route="straight", frames=FRAMES, seed=1002, width=312, height=96)
    write_kitti_root(SimulatedStreet(options), root, depth=True)
    return root


def exact(world: Path) -> Path:
    return world / "sequences" / "sim" / "depth_2"


@pytest.fixture(scope="module")
def arrays(world: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same depth as arrays of half the size, in thirds of a metre; the sky is NaN."""
    folder = tmp_path_factory.mktemp("arrays")
    for path in sorted(exact(world).glob("*.png")):
        depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[::2, ::2].astype(np.float32) / 256
        np.save(folder / f"{path.stem}.npy", np.where(depth > 0, 3 * depth, np.nan))
    return folder


@pytest.fixture(scope="module")
def exported(tiny_weights: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("onnxruntime")
    from erfsfm.checkpoint import load_model
    from erfsfm.export import export_onnx

    path = tmp_path_factory.mktemp("onnx") / "net.onnx"
    export_onnx(load_model(tiny_weights), path)
    return path


def positions(run: RunFolder, name: str = "optimised") -> np.ndarray:
    trajectory = run.trajectory(name)
    assert trajectory is not None
    return trajectory.positions


def run(world: Path, output: Path, source: str, *overrides: str, **options: Any) -> RunFolder:
    given = [*PLAIN, f"depth.source={source}", *overrides]
    return run_slam(world, "sim", overrides=given, output=output, **{"weights": "sim", **options})


def test_our_exported_network_gives_the_run_of_our_weights(
    world: Path, tiny_weights: Path, exported: Path, tmp_path: Path, check_run: CheckRun
) -> None:
    options = {"weights": tiny_weights, "frames": "0:9"}
    own = run(world, tmp_path / "own", "network", "output.report=true", **options)
    other = run(world, tmp_path / "other", f"onnx:{exported}", "output.report=true", **options)
    for name in ("network", "odometry", "optimised"):
        length = np.linalg.norm(positions(own, name)[-1])
        np.testing.assert_allclose(positions(other, name), positions(own, name), atol=2e-3 * length)
    provenance = check_run(other.path)["provenance"]
    assert (
        provenance["depth_source"] == f"onnx:{exported}" and len(provenance["depth_sha256"]) == 64
    )
    assert provenance["depth_sha256"] != provenance["weights_sha256"]
    before = check_run(own.path)["provenance"]
    assert (before["depth_source"], before["depth_sha256"]) == ("network", before["weights_sha256"])


def test_exact_depth_gives_a_run_of_the_right_scale_in_any_unit(
    world: Path, arrays: Path, tmp_path: Path
) -> None:
    pictures = run(world, tmp_path / "png", f"png:{exact(world)}")
    metrics = pictures.metrics().tree()
    assert metrics["scale"]["value"] == pytest.approx(1.0, abs=0.06)
    aligned = metrics["trajectories"]["optimised"]["align"]
    assert (
        aligned["7dof"]["scale"] == pytest.approx(1.0, abs=0.06)
        and aligned["7dof"]["ate_rmse_m"] < 0.3
    )
    thirds = run(world, tmp_path / "npy", f"npy:{arrays}")
    assert thirds.metrics().tree()["scale"]["value"] == pytest.approx(1 / 3, rel=0.06)
    length = float(np.linalg.norm(positions(pictures)[-1]))
    np.testing.assert_allclose(positions(thirds), positions(pictures), atol=0.03 * length)
    (place,) = localise(world / "sequences/sim/image_2/000012.png", pictures)
    assert place.T_world_camera is None or place.nearest_frame is not None


@pytest.mark.slow
def test_exact_depth_gives_a_map_and_a_report_that_names_it(
    world: Path, tmp_path: Path, check_run: CheckRun
) -> None:
    pictures = run(
        world, tmp_path / "png", f"png:{exact(world)}", *COARSE_MAP, "output.report=true"
    )
    assert check_run(pictures.path)["map"]["triangles"] > 0
    assert f"png:{exact(world)}" in (pictures.path / "report.html").read_text()


def test_a_range_of_frames_and_a_blank_one(
    world: Path, arrays: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = shutil.copytree(arrays, tmp_path / "arrays")
    np.save(folder / "000012.npy", np.full((48, 156), np.nan, np.float32))
    metrics = run(world, tmp_path / "run", f"npy:{folder}", frames="6:18").metrics().tree()
    assert metrics["status"] == "ok" and "frame 6 has no known depth" in caplog.text
    assert metrics["scale"]["value"] == pytest.approx(1 / 3, rel=0.06)


def test_depth_of_distorted_images_is_undistorted_with_them(world: Path, tmp_path: Path) -> None:
    depth, camera = exact(world) / "000000.png", tmp_path / "camera.yaml"
    lens: dict[str, Any] = {
        "width": 312,
        "height": 96,
        "fx": 180,
        "fy": 180,
        "cx": 155,
        "cy": 45,
        "fps": 10,
    }
    camera.write_text(yaml.safe_dump(lens | {"model": "opencv", "distortion": [-0.2, 0.03, 0, 0]}))
    recording = open_sequence(world, "sim", camera)
    pinhole, lens = recording.intrinsics, recording.undistortion
    assert lens is not None
    K, coefficients = (
        np.array([[180, 0, 155], [0, 180, 45], [0, 0, 1.0]]),
        np.array([-0.2, 0.03, 0, 0]),
    )
    maps = cv2.initUndistortRectifyMap(
        K, coefficients, np.eye(3), pinhole.K, (312, 96), cv2.CV_32FC1
    )
    stored = cv2.imread(str(depth), cv2.IMREAD_UNCHANGED).astype(np.float32) / 256
    wanted = cv2.remap(stored, *maps, cv2.INTER_NEAREST)
    source = f"png:{exact(world)}"
    folder = DepthFolder(
        DepthConfig(source=source), FrameNumbers(FRAMES, 0, FRAMES), 312, 96, lens.apply_to_depth
    )
    found = 1 / folder.disparity(recording.frame(0))
    both = (wanted > 0) & np.isfinite(found)
    assert np.quantile(np.abs(found / wanted - 1)[both], 0.9) < 0.04  # half a pixel of the road
    np.testing.assert_array_equal(np.isfinite(found), wanted > 0)
    assert (
        run(world, tmp_path / "run", source, camera=camera, frames="0:7").metrics().status == "ok"
    )


def test_a_relative_network_is_aligned_in_each_frame(world: Path, tmp_path: Path) -> None:
    folder = tmp_path / "relative"
    folder.mkdir()
    rng = np.random.default_rng(0)
    for path in sorted(exact(world).glob("*.png")):
        depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED).astype(np.float32) / 256
        disparity = np.where(depth > 0, 1 / np.maximum(depth, 0.1), 0)
        np.save(
            folder / f"{path.stem}.npy", rng.uniform(3, 30) * (disparity + 0.02).astype(np.float32)
        )
    chosen = ["depth.kind=disparity", "depth.align=affine"]
    metrics = run(world, tmp_path / "run", f"npy:{folder}", *chosen).metrics().tree()
    assert metrics["trajectories"]["optimised"]["align"]["7dof"]["scale"] == pytest.approx(
        1.0, abs=0.08
    )
    assert metrics["scale"]["spread"] < 0.15


def test_live_sessions_take_a_network_and_refuse_folders(
    world: Path, tiny_weights: Path, exported: Path, arrays: Path
) -> None:
    sequence = open_sequence(world, "sim")
    config = load_config(None, [f"depth.source=onnx:{exported}"])
    with Slam.from_weights(
        tiny_weights, sequence.intrinsics, config, sequence.camera_height_m
    ) as session:
        for k in range(6):
            session.add_frame(sequence.frame(k).image, 0.1 * k)
        assert len(session.trajectory()) == 6
    config = load_config(None, [f"depth.source=npy:{arrays}"])
    with pytest.raises(
        SlamError, match=r"npy:.* needs a whole sequence.*: choose network or onnx:FILE"
    ):
        Slam.from_weights(tiny_weights, sequence.intrinsics, config)


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("tiff:depth", "should be network, onnx:FILE, npy:FOLDER or png:FOLDER; got 'tiff:depth'"),
        ("onnx:gone.onnx", "cannot read gone.onnx"),
        ("npy:short", "short has 17 frames of .npy"),
        ("npy:pickled", "pickled/000005.npy holds Python objects, which are not loaded"),
        ("npy:unknown", "frames 0 to 4 have no known depth in npy:unknown"),
        ("onnx:damaged.onnx", "damaged.onnx is damaged or no ONNX file"),
    ],
)
def test_bad_sources_are_one_line_and_exit_1(
    world: Path,
    arrays: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    command_line: Callable[..., tuple[int, str, str]],
    source: str,
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    (shutil.copytree(arrays, tmp_path / "short") / "000017.npy").unlink()
    np.save(
        shutil.copytree(arrays, tmp_path / "pickled") / "000005.npy",
        np.array([[print]]),
        allow_pickle=True,
    )
    (tmp_path / "unknown").mkdir()
    for k in range(FRAMES):
        np.save(
            tmp_path / "unknown" / f"{k}.npy",
            np.full((48, 156), [np.nan, 0.0, -1.0, np.inf][k % 4], np.float32),
        )
    (tmp_path / "damaged.onnx").write_bytes(b"\x08\x07" * 99)
    words = [
        "run",
        "--dataset",
        world,
        "--weights",
        "sim",
        "--output",
        "out",
        "--set",
        f"depth.source={source}",
    ]
    code, _, err = command_line(slam.commands.cli.main, "erfsfm-slam", *words)
    (line,) = [each for each in err.strip().splitlines() if not each.startswith("WARNING")]
    assert code == 1 and message in line
    assert (tmp_path / "out").exists() == (source == "npy:unknown"), (
        "all else is found before the run begins"
    )
