"""An experiment: can kiss-icp, a LiDAR odometry, register the point clouds of learned depth?

The system runs with its usual settings; then the near part of every learned depth map becomes a point cloud, and
kiss-icp (Vizzo et al. 2023) registers cloud after cloud. Its trajectory is printed in one table with those of the run.
The result is described in docs/design/tried-without-success.md.

Example: python tools/kiss_icp_on_learned_depth.py --dataset KITTI --sequence 05 --weights sim
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from kiss_icp.config import load_config as load_kiss_icp_config
from kiss_icp.kiss_icp import KissICP
from rich.console import Console

from erfsfm.errors import ErfsfmError
from erfsfm.inference import DepthPosePredictor
from slam.config import load_config
from slam.errors import SlamError
from slam.evaluation.trajectory import trajectory_metrics
from slam.frames import DepthMap, Intrinsics
from slam.frontend.drive import Keyframe
from slam.pipeline.batch import SlamPipeline
from slam.prediction.networks import NetworkPredictor
from slam.results.tables import metrics_table
from slam.se3 import FloatArray, invert
from slam.sequences.catalogue import open_sequence
from slam.sequences.excerpt import Excerpt
from slam.storage.cache import CacheNamespace, DiskCache, without_cache
from slam.trajectory import Trajectory

SEED = 0
EDGE_RATIO = 0.12  # relative step of depth around a pixel beyond which it is an edge, as in map fusion


def main(words: Sequence[str] | None = None) -> None:
    """Run, register, print one table."""
    options = _parser().parse_args(words)
    try:
        recording = open_sequence(options.dataset, options.sequence, None, options.frames)
        networks = DepthPosePredictor.from_weights(options.weights, "cpu")
        answers = without_cache
        if options.cache is not None:
            answers = CacheNamespace(DiskCache(options.cache), networks.sha256).get_or_compute
        predictor = NetworkPredictor(networks, recording.intrinsics, answers=answers)
        result = SlamPipeline(recording, predictor, load_config(None, options.set)).estimate()
    except (SlamError, ErfsfmError) as error:
        raise SystemExit(str(error)) from error
    if result.reference is None or not result.drive.keyframes:
        raise SystemExit(f"{recording.name} has no true poses to compare with, or mapping.enabled=false kept no depth")
    keyframes = result.drive.keyframes
    rows = np.array([keyframe.index for keyframe in keyframes])
    truth = result.reference.select(rows).rebased()
    one_unit = np.full(len(recording), np.median(result.scale.per_frame))
    clouds = {
        "kiss-icp, one unit": in_metres(keyframes, one_unit),
        "kiss-icp, unit of each frame": in_metres(keyframes, result.scale.per_frame),
    }
    if options.true_depth is not None:
        first = recording.start if isinstance(recording, Excerpt) else 0
        clouds["kiss-icp, true depth"] = [true_depth(options.true_depth, first + int(row)) for row in rows]
    measured = {
        name: trajectory_metrics(estimate, result.reference)
        for name, estimate in (
            ("network", result.network),
            ("odometry", result.odometry),
            ("optimised", result.optimised),
        )
    }
    for name, depths in clouds.items():
        T_first_camera = registered(depths, recording.intrinsics, options.far_m, options.voxel_m, options.share)
        measured[name] = trajectory_metrics(Trajectory(truth.stamps, T_first_camera), truth)
    title = f"{recording.name}, {len(rows)} of {len(recording)} frames, scale mode {result.scale.mode}"
    Console(width=options.columns).print(metrics_table(measured, title))


def in_metres(keyframes: Sequence[Keyframe], unit: FloatArray) -> list[DepthMap]:
    """Depth ``(H, W)`` of keyframes; ``unit`` ``(N,)`` are the metres in an unscaled length at every frame."""
    return [keyframe.depth_unscaled * np.float32(unit[keyframe.index]) for keyframe in keyframes]


def true_depth(folder: Path, frame: int) -> DepthMap:
    """Depth ``(H, W)``, metres, as ``erfsfm-slam simulate --depth`` writes it, 0 where nothing was hit."""
    raw = cv2.imread(str(folder / f"{frame:06d}.png"), cv2.IMREAD_UNCHANGED)
    if raw is None:
        raise SystemExit(f"{folder} has no depth map {frame:06d}.png")
    return np.asarray(raw / np.float32(256))


def registered(
    depths: Sequence[DepthMap], intrinsics: Intrinsics, far_m: float, voxel_m: float, ratio: float
) -> FloatArray:
    """``T_first_camera`` ``(N, 4, 4)``, metres, of depth maps in time order; the rest as in ``cloud``."""
    settings = load_kiss_icp_config(None)
    settings.data.deskew = False
    settings.data.max_range = 2 * far_m  # a point at far_m of depth is farther away than that
    settings.mapping.voxel_size = voxel_m
    settings.registration.max_num_threads = 1  # the same bytes every time
    odometry = KissICP(settings)
    rng = np.random.default_rng(SEED)
    T_first_camera = []
    for depth in depths:
        odometry.register_frame(cloud(depth, intrinsics, far_m, ratio, rng), np.array([]))
        T_first_camera.append(odometry.last_pose.copy())
    return np.asarray(invert(T_first_camera[0]) @ np.stack(T_first_camera), dtype=np.float64)


def cloud(depth: DepthMap, intrinsics: Intrinsics, far_m: float, ratio: float, rng: np.random.Generator) -> FloatArray:
    """Points ``(P, 3)`` in the camera, metres, of some of the pixels that are near and not at an edge of depth.

    Pixels are drawn again for every frame: with the same rays in each, the road would be the same rings of points in
    every cloud, which biases registration towards no motion.
    """
    height, width = depth.shape
    camera = intrinsics.resized(width, height)
    window = np.ones((3, 3), np.uint8)
    smooth = cv2.dilate(depth, window) < (1 + EDGE_RATIO) * cv2.erode(depth, window)
    kept = rng.permutation(np.flatnonzero(smooth & (depth < far_m)))
    kept = kept[: round(ratio * len(kept))]
    v, u = np.divmod(kept, width)
    z = depth.ravel()[kept].astype(np.float64)
    return np.column_stack([z * (u - camera.cx) / camera.fx, z * (v - camera.cy) / camera.fy, z])


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--dataset", type=Path, help="as for erfsfm-slam run; default: the embedded sequence")
    add("--sequence")
    add("--frames", metavar="A:B", help="half-open")
    add("--weights", default="default")
    add("--set", nargs="+", default=(), metavar="KEY=VALUE", help="of the run")
    add("--cache", type=Path, help="cache folder of the networks' outputs")
    add("--true-depth", type=Path, metavar="FOLDER", help="16-bit depth maps (metres x 256) to register as a control")
    add("--far-m", type=float, default=40.0, help="points beyond are left out")
    add("--voxel-m", type=float, default=1.0, help="voxel of kiss-icp's map")
    add("--share", type=float, default=0.1, help="fraction of the pixels that become points")
    add("--columns", type=int, default=160, help="width of the table")
    return parser


if __name__ == "__main__":
    main()
