"""The commands ``erfsfm evaluate``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from erfsfm.cli_options import Device, Fidelity, Json, UnusedSeed, Weights, print_rows

evaluate_app = typer.Typer(
    no_args_is_help=True, rich_markup_mode=None, help="Depth and pose errors of trained networks."
)


@evaluate_app.command("depth")
def evaluate_depth(
    dataset: Annotated[
        list[Path], typer.Option(help="a root with depth_2, KITTI raw, or a folder of images/ and truth/; repeat")
    ],
    weights: Annotated[
        list[str], typer.Option(help="a shipped name (default, sim) or a training output folder; repeat to compare")
    ] = ["default"],  # noqa: B006
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
    output: Annotated[Path | None, typer.Option(help="a file that receives the JSON as well")] = None,
    device: Device = "auto",
    seed: UnusedSeed = 0,
    as_json: Json = False,
) -> None:
    """Depth errors under 80 m: Eigen's protocol with --split, else every fifth frame, and every street counts alike.

    Standard errors are those over streets. Several weights are compared by the ratio of their abs_rel to that of the
    first on each street, and by the geometric mean of the ratios. JSON has all errors. With --truth many-views no true
    depth is needed: static surfaces are measured from their neighbouring frames.

    Example: erfsfm evaluate depth --weights default --weights sim --dataset worlds --dataset KITTI_RAW --output d.json
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
    if len(dataset) > 1 and (truth == "many-views" or split is not None):
        raise ConfigError(f"--split and --truth many-views take one --dataset; got {len(dataset)}")
    if len(weights) > 1 and (truth == "many-views" or split is not None):
        raise ConfigError(f"--split and --truth many-views take one --weights; got {len(weights)}")
    networks = {name: DepthPosePredictor.from_weights(name, device) for name in weights}
    predictor = networks[weights[0]]
    with progress_bar() as show:
        if truth == "many-views":
            rows = many_view_protocol(predictor, dataset[0], sequence or (), cache, allow_leak, show)
        elif split is None:
            rows = depth_protocol(networks if len(networks) > 1 else {"networks": predictor}, dataset, allow_leak, show)
        else:
            rows = eigen_protocol(predictor, dataset[0], split, fidelity, allow_leak)
    _show(rows, output, as_json)


def _show(rows: list[dict[str, Any]], output: Path | None, as_json: bool) -> None:
    """Write the rows, if a file is named, and print them."""
    from erfsfm.common.files import write_atomically

    if output is not None:
        write_atomically(output, lambda path: path.write_text(json.dumps(rows, indent=2) + "\n"))
    print_rows(rows if as_json else _narrow(rows), as_json)


def _narrow(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """What of streets' rows fits into a table of 80 columns; other rows as they are."""
    if "abs_rel_se" not in rows[0]:
        return rows
    compares = any("ratio" in row for row in rows)
    shown = []
    for row in rows:
        head = {"street": row.get("street", "mean"), "weights": row["method"]}
        errors = {"abs_rel": row["abs_rel"], "se": row["abs_rel_se"]}
        if compares:
            shown.append(head | errors | {"ratio": row.get("ratio"), "ratio se": row.get("ratio_se")})
        else:
            errors |= {key: row[key] for key in ("rmse", "a1", "images", "leak")}
            shown.append({"method": row.get("street", row["method"])} | errors)
    return shown


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
