"""A COLMAP scene of a run: its corners are tracked through the images that see them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from slam.commands.export import export
from slam.formats.trajectory import Trajectory
from slam.frames import Frame
from slam.geometry.se3 import FloatArray, apply, invert
from slam.loops.features import FeatureExtractor
from slam.loops.places import Places
from slam.results.folder import RunFolder
from slam.runtime.files import PLACES
from slam.sequences.catalogue import SimulatedSequence
from slam.simulation.street import SimulationOptions

FRAMES, STRIDE = 18, 2


@pytest.fixture(scope="module")
def street() -> SimulatedSequence:
    return SimulatedSequence(SimulationOptions("straight", FRAMES, 630, 312, 96))


@pytest.fixture
def run(make_run: Callable[..., RunFolder], street: SimulatedSequence) -> RunFolder:
    """With the views of every second frame, without depth, at true poses; it does not record its images."""
    folder, extractor = make_run(), FeatureExtractor(street.intrinsics)
    assert street.reference is not None
    unknown = np.full((street.intrinsics.height, street.intrinsics.width), np.nan, np.float32)
    frames = range(0, FRAMES, STRIDE)
    views = tuple(extractor.view(Frame(k, 0.1 * k, street.frame(k).image), unknown) for k in frames)
    folder.write(PLACES, Places(street.intrinsics, views, street.reference[::STRIDE]).write)
    folder.write_trajectory("optimised", Trajectory(0.1 * np.arange(FRAMES), street.reference))
    folder.write_metrics(
        folder.metrics().changed(
            sequence=folder.metrics().sequence.model_copy(update={"frames": FRAMES})
        )
    )
    (folder.path / "map_cloud.ply").unlink()
    return folder


def rows(path: Path) -> list[list[str]]:
    return [line.split() for line in path.read_text().splitlines() if not line.startswith("#")]


def test_corners_are_tracked_through_the_images(
    run: RunFolder, street: SimulatedSequence, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    model = export(run, "colmap", tmp_path / "model")
    assert "does not record where its images are: the model has none" in caplog.text
    points, images = rows(model / "points3D.txt"), rows(model / "images.txt")
    assert len(points) > 100 and len(images) == 2 * FRAMES
    X: FloatArray = np.array([point[1:4] for point in points], float)
    assert street.reference is not None
    seen = 0
    for k, point in enumerate(points):
        for image, corner in zip(map(int, point[8::2]), map(int, point[9::2]), strict=True):
            corners = images[2 * image - 1]
            u, v, number = corners[3 * corner : 3 * corner + 3]
            assert int(number) == k + 1
            projected = street.intrinsics.project(
                apply(invert(street.reference[image - 1]), X[k][None])
            )[0]
            assert np.linalg.norm(projected + 0.5 - [float(u), float(v)]) < 4.0
            seen += 1
    assert seen >= 3 * len(points) == 3 * sum(len(point) >= 8 + 2 * 3 for point in points)
    T_street_first = street.street.T_world_camera[0]
    assert np.median(street.street.distance_to_surface(apply(T_street_first, X))) < 0.5


def test_points_are_chosen_by_the_length_of_their_tracks(run: RunFolder, tmp_path: Path) -> None:
    whole = [len(point) for point in rows(export(run, "colmap", tmp_path / "all") / "points3D.txt")]
    few = rows(export(run, "colmap", tmp_path / "few", "z", points=20) / "points3D.txt")
    assert [len(point) for point in few] == sorted(whole, reverse=True)[:20]
    X = np.array([point[1:4] for point in few], float)
    assert (X[:, 1] > 0).all(), "y is ahead where z is up"
