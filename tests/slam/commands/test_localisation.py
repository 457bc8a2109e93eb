"""Images of a mapped street are localised in its map; images of other places are refused with a reason."""

from __future__ import annotations

import functools
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from erfsfm.common.readers.camera_file import CameraFile
from slam.commands.localisation import Localiser, localisation_table, localise, write_localisations
from slam.config.sections import dump_yaml, load_config
from slam.formats.trajectory import Trajectory, associate, read_trajectory, write_kitti
from slam.frames import Frame, Image, Intrinsics
from slam.geometry.se3 import FloatArray, invert, rotation_angle
from slam.loops.features import FeatureExtractor
from slam.loops.places import Places
from slam.results.folder import RunFolder
from slam.runtime.errors import RunError, SequenceError
from slam.runtime.files import PLACES
from slam.sequences.camera_file import write_camera
from slam.simulation.options import SimulationOptions
from slam.simulation.recording import SimulatedSequence

UNIT = 0.5  # lengths of the map per metre
FRAMES = 45


@functools.cache
def street(seed: int, hazards: tuple[str, ...] = ()) -> SimulatedSequence:
    return SimulatedSequence(SimulationOptions("straight", FRAMES, seed, 312, 96, hazards))


def reference() -> FloatArray:
    T_world_camera = street(630).reference
    assert T_world_camera is not None
    return T_world_camera


@functools.cache
def places() -> Places:
    """Places as a run on every third frame keeps them, with exact depth."""
    sequence = street(630)
    extractor = FeatureExtractor(sequence.intrinsics)
    frames = range(0, FRAMES, 3)
    views = []
    for k in frames:
        image, depth = sequence.street.render(k), sequence.street.depth(k)
        depth[depth == 0] = np.nan
        views.append(
            extractor.view(Frame(k, 0.1 * k, image), depth, sequence.camera_height_m).scaled(UNIT)
        )
    T_world_camera = reference()[list(frames)].copy()
    T_world_camera[:, :3, 3] *= UNIT
    return Places(sequence.intrinsics, tuple(views), T_world_camera)


@pytest.fixture
def run(make_run: Callable[..., RunFolder]) -> RunFolder:
    folder = make_run()
    folder.write(PLACES, places().write)
    folder.write("config.yaml", dump_yaml(load_config()))
    return folder


@pytest.fixture
def album(tmp_path: Path) -> Path:
    """Three pictures of the street in other light, one of another street, one damaged."""
    folder = tmp_path / "album"
    folder.mkdir()
    for k in (10, 25, 40):
        save(folder / f"{k}.png", street(630, ("exposure",)).frame(k).image)
    save(folder / "50.png", street(631).frame(20).image)
    (folder / "60.png").write_bytes(b"damaged")
    return folder


def save(path: Path, image: Image) -> None:
    cv2.imwrite(str(path), np.ascontiguousarray(image[..., ::-1]))


@pytest.mark.slow
@pytest.mark.parametrize("hazards", [(), ("rain",)])  # the album has another exposure
def test_images_of_the_street_are_localised_where_they_were_taken(hazards: tuple[str, ...]):
    localiser = Localiser(places())
    found = 0
    for k in range(4, FRAMES - 4, 10):
        result = localiser.locate(f"{k}", street(630, hazards).frame(k).image)
        if result.T_world_camera is None:
            continue
        found += 1
        T_error = invert(reference()[k]) @ result.T_world_camera
        away = np.linalg.norm(result.T_world_camera[:3, 3] / UNIT - reference()[k, :3, 3])
        assert away < 0.5 and rotation_angle(T_error[:3, :3]) < np.deg2rad(1.0)
        assert (
            result.nearest_frame is not None
            and abs(result.nearest_frame - k) <= 2
            and result.inliers >= 20
        )
    assert found >= 3


def test_wrong_learned_depth_is_replaced_by_what_neighbouring_places_measure():
    rng = np.random.default_rng(0)
    views = tuple(
        replace(
            view, points=(view.points * rng.lognormal(0.0, 0.5, (len(view), 1))).astype(np.float32)
        )
        for view in places().views
    )
    localiser = Localiser(replace(places(), views=views))
    for k in (10, 40):
        found = localiser.locate(f"{k}", street(630).frame(k).image).T_world_camera
        assert (
            found is not None and np.linalg.norm(found[:3, 3] / UNIT - reference()[k, :3, 3]) < 0.5
        )


@pytest.mark.slow
def test_another_size_of_the_same_camera_is_found_too():
    image = street(630).frame(31).image
    twice = np.asarray(cv2.resize(image, (624, 192), interpolation=cv2.INTER_CUBIC), np.uint8)
    assert Localiser(places()).locate("twice", twice).nearest_frame in (30, 33)
    own = Localiser(places(), places().intrinsics.resized(624, 192)).locate("own", twice)
    assert np.linalg.norm(own.T_world_camera[:3, 3] / UNIT - reference()[31, :3, 3]) < 0.5
    with pytest.raises(
        SequenceError, match="the image is 300x192, its camera 312x96: give its --camera"
    ):
        Localiser(places()).locate("cut", twice[:, :300])


def bent(image: Image, camera: CameraFile) -> Image:
    """An image of a pinhole as a lens of the same K takes it."""
    K = Intrinsics.of(camera.pinhole).K
    pixels = street(630).intrinsics.pixel_grid().reshape(-1, 1, 2)
    seen = cv2.undistortPoints(pixels, K, np.array(camera.distortion), P=K).reshape(
        *image.shape[:2], 2
    )
    return np.asarray(cv2.remap(image, seen.astype(np.float32), None, cv2.INTER_LINEAR), np.uint8)


@pytest.mark.parametrize(
    ("where", "given"),
    [pytest.param("images", "images/25.png", marks=pytest.mark.slow), (".", "images"), (None, "")],
)
def test_images_of_a_lens_need_its_camera_file(
    run: RunFolder, tmp_path: Path, where: str | None, given: str
):
    """It is looked for where ``run`` looks."""
    run.write(
        PLACES, replace(places(), intrinsics=replace(places().intrinsics, undistorted=True)).write
    )
    pinhole = places().intrinsics
    keys = {name: getattr(pinhole, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    lens = CameraFile.model_validate(
        keys | {"fps": 10, "model": "opencv", "distortion": (-0.2, 0.0, 0.0, 0.0)}
    )
    (tmp_path / "album" / "images").mkdir(parents=True)
    save(tmp_path / "album" / "images" / "25.png", bent(street(630).frame(25).image, lens))
    if where is None:
        with pytest.raises(
            SequenceError,
            match=r"undistorted its images, and .*album has no camera\.yaml: give its",
        ):
            localise(tmp_path / "album", run)
        write_camera(run.path, lens, None)
        assert localise(tmp_path / "album", run)[0].T_world_camera is not None
        write_camera(run.path, lens, np.ones((lens.height, lens.width), np.bool_))
        assert localise(tmp_path / "album", run)[0].T_world_camera is None
        return
    (tmp_path / "album" / where / "camera.yaml").write_text(lens.model_dump_json(exclude_none=True))
    (found,) = localise(tmp_path / "album" / given, run)
    assert found.T_world_camera is not None, found.reason
    assert np.linalg.norm(found.T_world_camera[:3, 3] / UNIT - reference()[25, :3, 3]) < 0.5


def test_a_camera_of_another_size_is_refused_image_by_image(run: RunFolder, album: Path):
    camera = album / "camera.yaml"
    lens = "model: opencv, distortion: [-0.1, 0, 0, 0]"
    camera.write_text(
        f"{{width: 156, height: 48, fx: 90, fy: 90, cx: 77.5, cy: 23.5, fps: 10, {lens}}}"
    )
    for found in localise(album, run, camera)[:4]:
        assert (
            found.T_world_camera is None
            and "the image is 312x96, its camera 156x48: give" in found.reason
        )


@pytest.mark.parametrize(
    "what", ["another street", "black", pytest.param("noise", marks=pytest.mark.slow)]
)
def test_images_of_other_places_are_refused(what: str):
    images = {
        "another street": [street(seed).frame(k).image for seed, k in ((631, 5), (632, 40))],
        "noise": [np.random.default_rng(0).integers(0, 255, (96, 312, 3), np.uint8)],
        "black": [np.zeros((96, 312, 3), np.uint8)],
    }[what]
    localiser = Localiser(places())
    for image in images:
        result = localiser.locate(what, image)
        assert result.T_world_camera is None and result.nearest_frame is None and result.reason


@pytest.mark.slow
@pytest.mark.parametrize("zoom", [0.93, 1.1])
def test_images_by_another_lens_are_refused_where_its_camera_is_not_given(zoom: float):
    camera = places().intrinsics
    middle = np.array([camera.cx, camera.cy])
    zoomed = np.column_stack([zoom * np.eye(2), (1.0 - zoom) * middle])
    own = replace(camera, fx=zoom * camera.fx, fy=zoom * camera.fy)
    theirs, ours = Localiser(places()), Localiser(places(), own)
    for k in (8, 20):
        image = street(630).frame(k).image
        image = cv2.warpAffine(image, zoomed, (camera.width, camera.height))
        refused = theirs.locate(f"{k}", image)
        assert refused.T_world_camera is None and "times the focal length" in refused.reason
        found = ours.locate(f"{k}", image).T_world_camera
        assert np.linalg.norm(found[:3, 3] / UNIT - reference()[k, :3, 3]) < 0.5


def test_a_folder_of_images_is_localised_in_a_run(run: RunFolder, album: Path, tmp_path: Path):
    found = localise(album, run)
    assert [each.image for each in found] == ["10.png", "25.png", "40.png", "50.png", "60.png"]
    assert [each.T_world_camera is not None for each in found] == [True, True, True, False, False]
    assert "60.png" in found[4].reason
    entries = json.loads(json.dumps([each.tree() for each in found], allow_nan=False))
    assert entries[1]["found"] and abs(entries[1]["nearest_frame"] - 25) <= 2
    assert entries[3] | {"reason": ""} == {
        "image": "50.png",
        "found": False,
        **dict.fromkeys(("position", "T_world_camera", "nearest_frame", "inliers")),
        "reason": "",
    }
    assert len(localisation_table(found).rows) == 5
    write_localisations(tmp_path / "found.tum", found)
    written = read_trajectory(tmp_path / "found.tum")
    np.testing.assert_array_equal(written.stamps, [0.0, 1.0, 2.0])
    np.testing.assert_allclose(written.positions[1], entries[1]["position"], atol=1e-6)
    numbered = [replace(each, number=int(Path(each.image).stem)) for each in found]
    write_localisations(tmp_path / "found.kitti", numbered)
    write_kitti(tmp_path / "truth.txt", Trajectory(np.arange(float(FRAMES)), reference()))
    pair = associate(
        read_trajectory(tmp_path / "found.kitti"), read_trajectory(tmp_path / "truth.txt")
    )
    assert [len(each) for each in pair] == [3, 3]
    np.testing.assert_allclose(pair[0].positions / UNIT, pair[1].positions, atol=0.5)


def test_what_cannot_be_localised_is_one_line(run: RunFolder, album: Path, tmp_path: Path):
    with pytest.raises(RunError, match="none of 1 images was found"):
        write_localisations(tmp_path / "found.tum", localise(album / "50.png", run))
    assert not (tmp_path / "found.tum").exists()
    with pytest.raises(SequenceError, match="reaches outside"):
        localise(album, run, frames="0:6")
    run.write(PLACES, Places(places().intrinsics, (), np.zeros((0, 4, 4))).write)
    with pytest.raises(RunError, match=r"has no places: it ran with loops\.enabled=false"):
        localise(album, run)
