"""The commands ``erfsfm evaluate``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from erfsfm.cli_options import Device, Fidelity, Json, UnusedSeed, Weights, print_rows

evaluate_app = typer.Typer(no_args_is_help=True, help="Depth and pose errors of trained networks.")


@evaluate_app.command("depth")
def evaluate_depth(
    dataset: Annotated[
        Path, typer.Option(help="a root with true depth (erfsfm-slam simulate --depth), or KITTI raw with --split")
    ],
    weights: Weights = "default",
    truth: Annotated[
        Literal["measured", "many-views"],
        typer.Option(help="many-views: measured by optical flow at the poses of a run, for drives without true depth"),
    ] = "measured",
    sequence: Annotated[
        list[str] | None, typer.Option(help="with many-views: recordings, or frames of one: 00[250:300]; repeat")
    ] = None,
    cache: Annotated[
        Path | None, typer.Option(help="with many-views: folder that keeps poses and depth for the next time")
    ] = None,
    split: Annotated[
        str | None,
        typer.Option(help="frames of KITTI raw: eigen, a YAML split, or a file of lines 'drive frame' or image paths"),
    ] = None,
    fidelity: Fidelity = "default",
    allow_leak: Annotated[bool, typer.Option("--allow-leak", help="evaluate frames seen in training")] = False,
    device: Device = "auto",
    seed: UnusedSeed = 0,
    as_json: Json = False,
) -> None:
    """Depth errors under 80 m: Eigen's protocol with --split, else every fifth frame beside a median depth map.

    With --truth many-views no true depth is needed: static surfaces are measured from their neighbouring frames.

    Example: erfsfm evaluate depth --weights sim --dataset KITTI_RAW --split eigen --fidelity paper
    """
    from erfsfm.common.errors import ConfigError
    from erfsfm.common.progress import progress_bar
    from erfsfm.evaluation.eigen import eigen_protocol
    from erfsfm.evaluation.many_view_truth import many_view_protocol
    from erfsfm.evaluation.protocols import depth_protocol
    from erfsfm.inference import DepthPosePredictor

    if truth == "many-views" and split is not None:
        raise ConfigError("--truth many-views measures depth itself: leave --split out, name frames with --sequence")
    if truth == "measured" and (sequence or cache):
        raise ConfigError("--sequence and --cache belong to --truth many-views")
    if fidelity == "paper" and split is None:
        raise ConfigError("--fidelity paper needs --split eigen or a file of frames of KITTI raw")
    predictor = DepthPosePredictor.from_weights(weights, device)
    if truth == "many-views":
        with progress_bar() as show:
            rows = many_view_protocol(predictor, dataset, sequence or (), cache, allow_leak, show)
        print_rows(rows, as_json)
    elif split is None:
        print_rows(depth_protocol(predictor, dataset, allow_leak), as_json)
    else:
        print_rows(eigen_protocol(predictor, dataset, split, fidelity, allow_leak), as_json)


@evaluate_app.command("pose")
def evaluate_pose(
    dataset: Annotated[Path, typer.Option(help="a KITTI odometry root with poses")],
    sequence: Annotated[list[str], typer.Option(help="sequence names, or frames of one: 00[250:300]; repeat")],
    weights: Weights = "default",
    fidelity: Fidelity = "default",
    allow_leak: Annotated[bool, typer.Option("--allow-leak", help="evaluate frames seen in training")] = False,
    device: Device = "auto",
    seed: UnusedSeed = 0,
    as_json: Json = False,
) -> None:
    """Five-frame snippet ATE and RE, beside constant velocity straight ahead as a baseline.

    Example: erfsfm evaluate pose --weights default --dataset KITTI --sequence 09 --sequence 10
    """
    from erfsfm.evaluation.protocols import pose_protocol
    from erfsfm.inference import DepthPosePredictor

    predictor = DepthPosePredictor.from_weights(weights, device)
    print_rows(pose_protocol(predictor, dataset, sequence, fidelity, allow_leak), as_json)
