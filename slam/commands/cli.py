"""The command line ``erfsfm-slam``."""

from __future__ import annotations

import logging
import shlex
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from erfsfm import __version__
from erfsfm.common import command_line
from erfsfm.common.progress import progress_bar
from slam.commands.batch.cli import verbs as batch_verbs
from slam.commands.calibration.cli import verbs as calibration_verbs
from slam.commands.downloads.cli import verbs as download_verbs
from slam.commands.evaluation import verbs as evaluation_verbs
from slam.commands.exports.cli import verbs as export_verbs
from slam.commands.live.cli import verbs as live_verbs
from slam.commands.localisation.cli import verbs as localisation_verbs
from slam.commands.options import Json, Seed, UnusedDevice, options_of
from slam.commands.run.request import RunRequest
from slam.runtime.errors import SlamError
from slam.runtime.terminal import print_table

if TYPE_CHECKING:
    from slam.results.metrics import Metrics

app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode=None,  # markup would remove <...> or [...] from the help
    pretty_exceptions_enable=False,
    help="Monocular SLAM on learned depth and ego-motion, on a CPU.",
)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"erfsfm-slam {__version__}")
        raise typer.Exit


@app.callback()
def _options_of_all_verbs(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="print the version and exit")
    ] = False,
) -> None:
    pass


@app.command()
@options_of(RunRequest)
def run(request: RunRequest, as_json: Json = False) -> None:
    """Trajectory, map and report of a sequence. Without options: the embedded simulated street.

    Example: erfsfm-slam run --dataset KITTI --sequence 09
    """
    from slam.commands.run.run import perform

    with progress_bar() as progress:
        folder = perform(replace(request, progress=progress, command=shlex.join(["erfsfm-slam", *sys.argv[1:]])))
    metrics = folder.metrics()
    if as_json:
        typer.echo(metrics.to_json())
        return
    _print_run(folder.path, metrics)


app.add_typer(evaluation_verbs)
app.add_typer(export_verbs)
app.add_typer(batch_verbs)
app.add_typer(live_verbs)
app.add_typer(calibration_verbs)
app.add_typer(download_verbs)
app.add_typer(localisation_verbs)


@app.command()
def simulate(
    output: Annotated[Path, typer.Argument(help="the root to write")],
    route: Annotated[str, typer.Option(help="loop, grid or straight streets, or rooms")] = "loop",
    frames: Annotated[int, typer.Option(help="about 1 m apart on a street; a loop needs 250 or more")] = 300,
    seed: Seed = 0,
    width: Annotated[int, typer.Option(help="pixels")] = 416,
    height: Annotated[int, typer.Option(help="pixels")] = 128,
    lidar: Annotated[bool, typer.Option("--lidar", help="write 64-beam scans")] = False,
    depth: Annotated[bool, typer.Option("--depth", help="write exact depth maps")] = False,
    mesh: Annotated[bool, typer.Option("--mesh", help="write the true surface, mesh.ply")] = False,
    hazards: Annotated[
        str,
        typer.Option(
            help="comma list of moving-cars, exposure, blur, stop, rain; "
            "of rooms people, exposure, blur, rolling-shutter, stop"
        ),
    ] = "",
    varied: Annotated[
        bool,
        typer.Option(
            "--varied", help="any camera, hills, hard light, kinds of street, people, overtaking; of rooms another lens"
        ),
    ] = False,
    motion: Annotated[
        str | None, typer.Option(help="how the camera goes through rooms: walk, look, phone, drone or robot")
    ] = None,
    rate: Annotated[float, typer.Option(help="frames a second, of rooms 5 to 60")] = 10.0,
    device: UnusedDevice = "auto",
) -> None:
    """A simulated street, or simulated rooms, as a KITTI odometry root. Its ground truth is exact.

    Example: erfsfm-slam simulate world --route grid --frames 600 --seed 600 --depth --lidar
    """
    from slam.simulation.kitti_layout import simulated_world, write_kitti_root
    from slam.simulation.options import parse_options

    world = simulated_world(parse_options(route, frames, seed, width, height, hazards, varied, motion, rate))
    with progress_bar() as progress:
        write_kitti_root(world, output, depth, lidar, lambda done: progress("frames", done, frames), mesh)
    typer.echo(f"{frames} frames in {output}: erfsfm-slam run --dataset {output} --sequence sim")


@app.command()
def config() -> None:
    """The full default configuration as YAML.

    Example: erfsfm-slam config > mine.yaml && erfsfm-slam run --config mine.yaml
    """
    from slam.config.sections import SlamConfig, dump_yaml

    typer.echo(dump_yaml(SlamConfig()), nl=False)


@app.command()
def doctor(
    dataset: Annotated[Path | None, typer.Option(help="a data set to check")] = None,
    camera: Annotated[
        Path | None, typer.Option("--camera", "--calibration", help="camera.yaml of the data set, or fov=70")
    ] = None,
) -> None:
    """Check the installation. Missing parts come with what to do, and exit code 1.

    Example: erfsfm-slam doctor --dataset /data/kitti
    """
    from slam.commands.doctor import NO_DATA_SET, examine

    lines = examine(dataset, camera)
    for line in lines:
        typer.echo(line)
    missing = sum(line.startswith("missing") for line in lines if line != NO_DATA_SET)
    if missing:
        raise SlamError(f"{missing} of {len(lines)} parts are missing: do what their lines say")


def _print_run(path: Path, metrics: Metrics) -> None:
    from slam.results.error_columns import written
    from slam.results.report.verdict import verdict
    from slam.results.terminal_tables import metrics_table
    from slam.runtime.run_files import REPORT
    from slam.runtime.storage.record import Missing, known

    sequence, provenance, timing = metrics.sequence, metrics.provenance, metrics.timing
    title = f"{known(sequence.name)}, scale {known(metrics.scale.mode)}"
    if isinstance(sequence.length_m, Missing):
        typer.echo(f"{title}: no errors, for {sequence.length_m.reason}")
    else:
        print_table(metrics_table(metrics.evaluated_errors(), title))
    if (sure := known(metrics.confidence.run)) is not None:
        typer.echo(f"confidence {written(sure, 2)}: this share of drives like it err by at most 1 % of their path")
    if (found := verdict(metrics)) is not None and found.doubts:
        typer.echo(f"doubts: {'; '.join(found.doubts)}")
    for note in metrics.unit_notes():
        typer.echo(note)
    for gap in sequence.bridged:
        typer.echo(f"INTERPOLATED: frames {gap.first} to {gap.last}: {gap.reason}")
    depth = "" if provenance.depth_source == "network" else f"; depth {known(provenance.depth_source)}"
    typer.echo(f"weights {known(provenance.weights)}: {known(provenance.weights_licence)}{depth}")
    seconds, per_second = written(timing.seconds_total, 1), written(timing.frames_per_second, 1)
    report = path / REPORT
    typer.echo(
        f"{known(sequence.frames) or 0} frames in {seconds} s ({per_second} a second); everything in {path}"
        + (f", read {report}" if report.is_file() else "")
    )


def main() -> None:
    """Run the command line: a known error becomes one line and exit code 1."""
    command_line.run(app, "erfsfm-slam", logging.WARNING)  # run.log has the rest
