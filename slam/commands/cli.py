"""The command line ``erfsfm-slam``: every verb with its options."""

from __future__ import annotations

import json
import logging
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from erfsfm.common import command_line
from erfsfm.common.command_line import Device, Json, Overrides, Seed, UnusedDevice, UnusedSeed
from erfsfm.common.progress import progress_bar
from slam.runtime.errors import RunError, SlamError

if TYPE_CHECKING:
    from slam.results.folder import RunFolder

app = command_line.application(
    "erfsfm-slam", "Monocular SLAM on learned depth and ego-motion, on a CPU."
)

Sequence = Annotated[
    str | None,
    typer.Option(
        "--sequence", "-s", help="name inside the data set, e.g. 09; of a bag the image topic"
    ),
]
Camera = Annotated[
    Path | None,
    typer.Option(help="camera.yaml, or fov=70,height=1.4,fps=30 (degrees, metres), or auto (run)"),
]
Frames = Annotated[str | None, typer.Option(help="A:B, half-open")]
Weights = Annotated[str, typer.Option(help="default, sim, erf-dfc, erf-dfcv2 or a training output")]
Config = Annotated[str | None, typer.Option(help="a YAML file or a shipped name")]
Output = Annotated[Path | None, typer.Option(help="the run folder; else results/<stamp>_<name>")]


@app.command()
def run(
    context: typer.Context,
    dataset: Annotated[
        Path | None,
        typer.Option(help="a data set, image folder or video: docs/recordings.md lists all kinds"),
    ] = None,
    sequence: Sequence = None,
    camera: Camera = None,
    weights: Weights = "default",
    config: Config = None,
    overrides: Overrides = None,
    frames: Frames = None,
    truth: Annotated[
        Path | None,
        typer.Option(help="true camera poses: KITTI (a row a frame) or TUM (by stamps)"),
    ] = None,
    output: Output = None,
    rerun: Annotated[
        Path | None, typer.Option(help="also write an .rrd file for the rerun viewer (extra)")
    ] = None,
    gps: Annotated[Path | None, typer.Option(help="GPS track, CSV")] = None,
    seed: Seed = 0,
    device: Device = "auto",
    as_json: Json = False,
) -> None:
    """Trajectory, map and report of a sequence. Without options: the embedded simulated street.

    Example: erfsfm-slam run --dataset KITTI --sequence 09
    """
    from slam.commands.run import RunRequest, perform

    with progress_bar() as progress:
        folder = perform(RunRequest.of(**_given(context), progress=progress))
    if as_json:
        typer.echo(folder.metrics().to_json())
    else:
        _print_run(folder)


@app.command()
def live(
    context: typer.Context,
    dataset: Annotated[
        str, typer.Option(help="number of a camera, address of a stream, video, or folder")
    ],
    camera: Camera = None,
    every_frame: Annotated[
        bool,
        typer.Option("--every-frame", help="wait for each image of a folder or video; drop none"),
    ] = False,
    output: Output = None,
    view: Annotated[bool, typer.Option("--view", help="open the rerun viewer (extra)")] = False,
    wait: Annotated[
        float, typer.Option(min=0.1, max=1e6, help="seconds without an image that end the stream")
    ] = 10.0,
    weights: Weights = "default",
    config: Config = None,
    overrides: Overrides = None,
    seed: Seed = 0,
    device: Device = "auto",
) -> None:
    """Poses while frames arrive, one JSON line a frame. Ctrl-C, or the end of the stream, leaves a whole run folder.

    Example: erfsfm-slam live --dataset 0 --camera camera.yaml --output walk
    """
    from slam.commands.live import LiveRequest, run_live

    folder = run_live(
        LiveRequest.of(**_given(context)), lambda message: typer.echo(json.dumps(message))
    )
    typer.echo(f"everything in {folder.path}", err=True)


@app.command()
def batch(
    drives: Annotated[Path, typer.Argument(help="a manifest (CSV), or a data set")],
    output: Annotated[Path, typer.Option(help="holds a run folder for each drive, and drives.csv")],
    sequence: Annotated[
        list[str] | None, typer.Option("--sequence", "-s", help="sequence of the data set; repeat")
    ] = None,
    workers: Annotated[int, typer.Option(min=1, help="drives at a time on this machine")] = 1,
    scheduler: Annotated[
        str | None, typer.Option(help="address of a Dask scheduler in place of this machine")
    ] = None,
    threads: Annotated[
        int | None,
        typer.Option(
            min=1, help="threads of a drive; default: the cores of this machine by the workers"
        ),
    ] = None,
    memory: Annotated[
        float, typer.Option(min=0, help="GiB that a drive may use; 0: all (Linux)")
    ] = 0.0,
    weights: Annotated[str | None, typer.Option(help="as for run")] = None,
    config: Config = None,
    overrides: Overrides = None,
    frames: Frames = None,
    seed: Seed = 0,
    device: Device = "auto",
) -> None:
    """Many drives at once, each in a process of its own. Started again, it runs what is not whole.

    Example: erfsfm-slam batch drives.csv --workers 4 --output drives
    """
    from slam.commands.batch import CSV, drives_of, options_of_drives, run_drives, summary_table

    if memory and not Path("/proc/self/statm").exists():
        raise SlamError("--memory needs Linux: leave it out here")
    options = options_of_drives(weights, config, overrides or [], frames, seed, device)
    planned = drives_of(drives, sequence or ["all"], options)
    with progress_bar() as progress:
        outcomes = run_drives(planned, output, workers, scheduler, progress, threads, memory)
    summary_table(outcomes).print()
    failed = [outcome for outcome in outcomes if outcome.status == "failed"]
    kept = sum(outcome.status == "kept" for outcome in outcomes)
    typer.echo(
        f"{len(outcomes)} drives, {kept} of them whole before, {len(failed)} failed: {output / CSV}"
    )
    if failed:
        rest = "; the others are whole" if len(failed) < len(outcomes) else ""
        first = f"{failed[0].drive.name}: {failed[0].reason}"
        raise RunError(f"{len(failed)} of {len(outcomes)} drives failed{rest}; {first}")


@app.command()
def evaluate(
    paths: Annotated[
        list[str],
        typer.Argument(
            help="ESTIMATE REFERENCE (files or a run), or runs; with --reference any of both"
        ),
    ],
    reference: Annotated[
        Path | None, typer.Option(help="the truth: a trajectory file or a run folder")
    ] = None,
    frames: Annotated[str | None, typer.Option(help="A:B of the reference, half-open")] = None,
    format: Annotated[Literal["auto", "kitti", "tum"], typer.Option(help="of the files")] = "auto",
    times: Annotated[
        Path | None,
        typer.Option(help="of the rows of KITTI files, as times.txt: compared by stamps"),
    ] = None,
    csv: Annotated[Path | None, typer.Option(help="all numbers, with --reference")] = None,
    fail_over: Annotated[
        list[str] | None, typer.Option(help="METRIC=VALUE: exit 1 if it is larger; repeat")
    ] = None,
    as_json: Json = False,
    seed: UnusedSeed = 0,
    device: UnusedDevice = "auto",
) -> None:
    """Errors of trajectories or of whole runs.

    Of two trajectories, files or that of a run: all metrics under all alignments. Of run folders: their tables side by
    side. With --reference: one table of any number of files and runs. NAME=PATH names a system; of several with one
    NAME the table has mean and deviation.

    Example: erfsfm-slam evaluate ours=results/latest "orb=orb_*.txt" --reference poses/09.txt
    """
    from slam.commands import evaluation

    files, limits = [Path(path) for path in paths], fail_over or []
    evaluation.require_metrics(limits)
    if reference is not None:
        evaluation.against_reference(paths, reference, frames, format, limits, as_json, csv, times)
    elif frames or csv:
        raise typer.BadParameter("--frames and --csv need --reference FILE")
    elif all(path.is_dir() for path in files):
        if limits:
            raise typer.BadParameter(
                "a limit applies to trajectory files: give --reference", param_hint="--fail-over"
            )
        evaluation.of_runs(files, as_json)
    elif len(files) == 2:
        evaluation.of_two(files[0], files[1], format, limits, as_json, times)
    else:
        given = ", ".join(paths)
        raise typer.BadParameter(
            f"give two trajectory files, run folders that exist, or --reference FILE; got {given}"
        )


@app.command()
def export(
    run: Annotated[Path, typer.Argument(help="a run folder")],
    what: Annotated[
        Literal["mesh", "cloud", "colmap", "nerfstudio", "occupancy"],
        typer.Option(help="the part of the run"),
    ],
    output: Annotated[
        Path, typer.Option(help="the file to write; for colmap and nerfstudio a folder")
    ],
    up: Annotated[
        Literal["y-down", "z"], typer.Option(help="axes of the world: those of the camera, or z up")
    ] = "y-down",
    resolution: Annotated[
        float | None,
        typer.Option(min=1e-6, help="side of a cell of an occupancy grid, 0.1 by default"),
    ] = None,
    dataset: Annotated[
        Path | None,
        typer.Option(help="where the images of the run are now, for colmap and nerfstudio"),
    ] = None,
    points: Annotated[
        int | None, typer.Option(min=1, help="at most so many points of a COLMAP model")
    ] = None,
    seed: UnusedSeed = 0,
    device: UnusedDevice = "auto",
) -> None:
    """Parts of a run as files for other programs.

    The mesh or the cloud as PLY, the run as a COLMAP model or as a nerfstudio scene (transforms.json and images), or
    the map as an occupancy grid for ROS.

    Example: erfsfm-slam export results/latest --what mesh --output map.ply --up z
    """
    from slam.commands.export import export as export_run
    from slam.results.folder import RunFolder

    folder = RunFolder.open(run)
    with progress_bar() as progress:
        written = export_run(
            folder,
            what,
            output,
            up,
            resolution=resolution,
            dataset=dataset,
            points=points,
            progress=progress,
        )
    typer.echo(f"{what} of {run} in {written}")
    for note in folder.metrics().unit_notes():
        typer.echo(note)


@app.command()
def localize(
    images: Annotated[Path, typer.Argument(help="an image or a folder of images")],
    map: Annotated[Path, typer.Option("--map", help="a run folder")],
    camera: Annotated[
        Path | None,
        typer.Option(help="camera.yaml or fov=70; default: beside the images, else the run's"),
    ] = None,
    frames: Frames = None,
    every: Annotated[int, typer.Option(min=1, help="every n-th of them")] = 1,
    output: Annotated[
        Path | None,
        typer.Option(help="poses found, as TUM with image numbers as stamps, or .kitti"),
    ] = None,
    as_json: Json = False,
    seed: UnusedSeed = 0,
    device: UnusedDevice = "auto",
) -> None:
    """Poses of new images in an earlier run's map. They are in its frame and unit.

    Example: erfsfm-slam localize photos --map results/latest --output photos.tum
    """
    from slam.commands.localisation import localisation_table, localise, write_localisations
    from slam.results.folder import RunFolder, check_replaced

    run_folder = RunFolder.open(map)
    if output is not None:
        check_replaced(output)
    with progress_bar() as progress:
        found = localise(images, run_folder, camera, frames, every, progress)
    if output is not None:
        write_localisations(output, found)
    if as_json:
        typer.echo(json.dumps([each.tree() for each in found], indent=2))
    else:
        localisation_table(found).print()
        for note in run_folder.metrics().unit_notes():
            typer.echo(note)
    raise typer.Exit(all(each.T_world_camera is None for each in found))


@app.command()
def simulate(
    output: Annotated[Path, typer.Argument(help="the root to write")],
    route: Annotated[str, typer.Option(help="loop, grid or straight streets, or rooms")] = "loop",
    frames: Annotated[
        int, typer.Option(help="about 1 m apart on a street; a loop needs 250 or more")
    ] = 300,
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
            "--varied",
            help="any camera, hills, hard light, kinds of street, people, overtaking; of rooms another lens",
        ),
    ] = False,
    motion: Annotated[
        str | None,
        typer.Option(help="of the camera in rooms: walk, look, phone, drone, robot or turn"),
    ] = None,
    rate: Annotated[float, typer.Option(help="frames a second, of rooms 5 to 60")] = 10.0,
    device: UnusedDevice = "auto",
) -> None:
    """A simulated street, or simulated rooms, as a KITTI odometry root. Its ground truth is exact.

    Example: erfsfm-slam simulate world --route grid --frames 600 --seed 600 --depth --lidar
    """
    from slam.simulation.options import SimulationOptions
    from slam.simulation.recording import simulated_world, write_kitti_root

    named = tuple(name.strip() for name in hazards.split(",") if name.strip())
    world = simulated_world(
        SimulationOptions(route, frames, seed, width, height, named, varied, motion, rate)
    )
    with progress_bar() as progress:
        write_kitti_root(world, output, depth, lidar, progress, mesh)
    typer.echo(f"{frames} frames in {output}: erfsfm-slam run --dataset {output} --sequence sim")


@app.command()
def calibrate(
    recording: Annotated[Path, typer.Argument(help="a video or a folder of images of the board")],
    board: Annotated[
        str, typer.Option(help="corners between the squares: 9x6 for 10 by 7 squares")
    ],
    output: Annotated[Path, typer.Option(help="the camera.yaml to write")] = Path("camera.yaml"),
    square_m: Annotated[
        float, typer.Option(min=1e-4, max=10.0, help="side of a square in metres")
    ] = 0.03,
    model: Annotated[
        Literal["opencv", "fisheye"], typer.Option(help="lens; fisheye beyond 110 degrees")
    ] = "opencv",
    pattern: Annotated[
        Literal["chessboard", "charuco"], typer.Option(help="pattern of the board")
    ] = "chessboard",
    dictionary: Annotated[
        str, typer.Option(help="OpenCV's dictionary of the ArUco markers")
    ] = "5X5_100",
    marker_share: Annotated[
        float, typer.Option(min=0.1, max=0.99, help="side of a marker over that of a square")
    ] = 0.75,
    fps: Annotated[
        float | None,
        typer.Option(min=1e-3, max=1e4, help="frame rate to write; default: the video's, or 10"),
    ] = None,
    seed: UnusedSeed = 0,
    device: UnusedDevice = "auto",
) -> None:
    """A camera.yaml from images of a chessboard or a ChArUco board.

    Images are chosen for spread and sharpness. The fit is drawn beside the output. Nothing is written where the images
    do not determine the camera.

    Example: erfsfm-slam calibrate board.mp4 --board 9x6 --square-m 0.03 --output camera.yaml
    """
    from slam.commands.calibration import calibrate_camera
    from slam.sequences.calibration import Board, parse_board

    wanted = Board(*parse_board(board), square_m, pattern, dictionary, marker_share)
    with progress_bar() as progress:
        lines = calibrate_camera(recording, wanted, model, output, fps, progress)
    for line in lines:
        typer.echo(line)


@app.command()
def download(
    data_set: Annotated[Literal["kitti-odometry"], typer.Argument(help="the data set")],
    sequence: Annotated[str, typer.Option("--sequence", "-s", help="such as 09")],
    to: Annotated[Path, typer.Option(help="folder that gets it")],
    camera: Annotated[Literal["colour", "grey"], typer.Option(help="which images")] = "colour",
    lidar: Annotated[bool, typer.Option("--lidar", help="scans as well")] = False,
    accept_licence: Annotated[
        bool, typer.Option("--accept-licence", help="you accept the licence that is shown")
    ] = False,
    mirror: Annotated[
        str | None, typer.Option(help="address of the archives, in place of the official one")
    ] = None,
) -> None:
    """One sequence of KITTI odometry from its official server.

    Of its archives only the files of the sequence are fetched. Run again, an interrupted download goes on.

    Example: erfsfm-slam download kitti-odometry --sequence 09 --to KITTI
    """
    from slam.commands.download import LICENCE, SERVER, download_kitti

    typer.echo(LICENCE)
    if not accept_licence:
        if not sys.stdin.isatty():
            raise SlamError("the licence above is to be accepted: give --accept-licence")
        if not typer.confirm("Do you accept it?"):
            raise SlamError("the licence was not accepted: nothing is downloaded")
    with progress_bar() as progress:
        count = download_kitti(sequence, to, mirror or SERVER, camera == "grey", lidar, progress)
    typer.echo(f"{count} files in {to}: erfsfm-slam run --dataset {to} --sequence {sequence}")


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
        Path | None, typer.Option(help="camera.yaml of the data set, or fov=70")
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


def _print_run(folder: RunFolder) -> None:
    """The errors of a run, what raises doubt, and where everything is."""
    from slam.results.report.tables import by_reason
    from slam.results.tables import errors_table, motion_line, written
    from slam.results.verdict import how_sure, verdict
    from slam.runtime.files import REPORT

    metrics = folder.metrics()
    sequence, provenance, timing = metrics.sequence, metrics.provenance, metrics.timing
    title = f"{sequence.name}, scale {metrics.scale.mode}"
    if sequence.length_m is None:
        typer.echo(f"{title}: no errors, for {sequence.why('length_m')}")
    else:
        errors_table(metrics.evaluated_errors(), title).print()
    if line := motion_line(metrics):
        typer.echo(f"estimated path: {line}")
    sure, words = how_sure(metrics)
    if sure is not None:
        typer.echo(f"confidence {written(sure, 2)}: this share of drives like it {words}")
    if (found := verdict(metrics)) is not None and found.doubts:
        typer.echo(f"doubts: {'; '.join(found.doubts)}")
    for note in metrics.unit_notes():
        typer.echo(note)
    for line in by_reason(sequence.bridged or ()):
        typer.echo(f"INTERPOLATED: {line}")
    depth = "" if provenance.depth_source == "network" else f"; depth {provenance.depth_source}"
    typer.echo(f"weights {provenance.weights}: {provenance.weights_licence}{depth}")
    seconds, per_second = written(timing.seconds_total, 1), written(timing.frames_per_second, 1)
    report = folder.path / REPORT
    typer.echo(
        f"{sequence.frames or 0} frames in {seconds} s ({per_second} a second); everything in {folder.path}"
        + (f", read {report}" if report.is_file() else "")
    )


def _given(context: typer.Context) -> dict[str, Any]:
    """The options of a verb by name, and the whole command."""
    options = {name: value for name, value in context.params.items() if name != "as_json"}
    return options | {"command": shlex.join(["erfsfm-slam", *sys.argv[1:]])}


def main() -> None:
    """Run the command line: a known error becomes one line and exit code 1."""
    command_line.run(app, "erfsfm-slam", logging.WARNING)  # run.log has the rest
