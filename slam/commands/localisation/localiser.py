"""Localisation of new images in the map of an old run: image retrieval, then PnP against the points of each place."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from erfsfm.common.errors import DataError
from erfsfm.common.readers.camera_file import CAMERA_FILE, CameraFile
from erfsfm.common.readers.folder import image_folder
from erfsfm.common.readers.images import list_images, read_image
from erfsfm.common.readers.numbering import in_order
from erfsfm.common.threads import take_working_memory
from slam.config.sections import LoopsConfig, load_stored
from slam.frames import Frame, Image, Intrinsics, View
from slam.geometry.se3 import FloatArray, apply, invert
from slam.loops.descriptors import FeatureExtractor
from slam.loops.places import Places
from slam.loops.retrieval import PlaceIndex
from slam.loops.thresholds import LoopThresholds
from slam.loops.verification import LoopVerifier, matches
from slam.results.folder import RunFolder
from slam.runtime.errors import RunError, SequenceError
from slam.runtime.run_files import CONFIG, PLACES
from slam.sequences.camera_file import beside, explicit_camera, is_field_of_view, read_explicit
from slam.sequences.excerpt import frame_range
from slam.sequences.images import ImageFiles
from slam.sequences.undistortion import Undistortion

_PLACES_TRIED = 8
# lower than for loops: corners match at several places, and learned depth is too uncertain for those seen from close by
_MIN_INLIER_RATIO = 0.25
_ASPECT_TOLERANCE = 0.01


@dataclass(frozen=True)
class Localisation:
    """The pose ``T_world_camera`` of an image in the unit of the map; or None and the reason."""

    image: str
    T_world_camera: FloatArray | None = None
    nearest_frame: int | None = None
    inliers: int = 0
    reason: str = ""


def image_numbers(images: Path, frames: str | None = None, every: int = 1) -> range:
    """Numbers of the images to localise, from 0: every n-th of ``A:B``, half-open.

    Raises:
        SequenceError: no images, or the range is empty or reaches beyond them.
    """
    first, last = frame_range(frames or ":", len(image_paths(images)))
    return range(first, last, every)


def localise(
    images: Path, run: RunFolder, camera: Path | None = None, numbers: range | None = None
) -> Iterator[Localisation]:
    """Localise images in the map of a run, one after the other.

    Args:
        images: an image or a folder of images.
        run: a finished run with loops switched on.
        camera: their ``camera.yaml``; None for the one beside them or their folder, or else the camera of the run.
        numbers: of the images to localise; None for all of them.

    Raises:
        SlamError, DataError: no images, no places in the run, a camera file that does not fit, or none where the run
            undistorted its images.
    """
    take_working_memory()
    paths = image_paths(images)
    places = Places.read(run.require(PLACES))
    if not places.views:
        raise RunError(f"{run.path} has no places: it ran with loops.enabled=false; run the sequence again")
    own_camera = _camera_file(camera, images, paths)
    if own_camera is None and places.intrinsics.undistorted:
        raise SequenceError(
            f"{run.path} undistorted its images, and {images} has no {CAMERA_FILE}: give its --camera, which is fov=70 "
            "for images without distortion"
        )
    localiser = Localiser(
        places,
        load_stored(run.require(CONFIG), "loops").loops,
        None if own_camera is None else _pinhole(own_camera),
    )
    undistortion = Undistortion(own_camera) if own_camera is not None and own_camera.is_distorted else None
    chosen = paths if numbers is None else [paths[number] for number in numbers]
    unreadable = 0
    for path in chosen:
        try:
            image = read_image(path)
        except DataError as error:
            unreadable += 1
            if unreadable == len(chosen):
                raise  # not one of them is an image
            yield Localisation(path.name, reason=str(error))
            continue
        try:
            if undistortion is not None:
                image = undistortion.apply(image)
            yield localiser.locate(path.name, image)
        except SequenceError as error:
            yield Localisation(path.name, reason=str(error))


class Localiser:
    """Localises single images among the places of one run; no network is used."""

    def __init__(self, places: Places, config: LoopsConfig, intrinsics: Intrinsics | None = None) -> None:
        """Index the places.

        Args:
            places: of an old run, at least one view.
            config: thresholds, those of the run's own loops.
            intrinsics: of the new images; None for those of the run, with images resized to it.
        """
        self._places = places
        self._thresholds = LoopThresholds.of_frames(config)
        self._resizes = intrinsics is None
        self._intrinsics = intrinsics or places.intrinsics
        self._features = FeatureExtractor(self._intrinsics)
        self._verifier = LoopVerifier(self._thresholds, self._intrinsics)
        self._index = PlaceIndex(places.views)

    def locate(self, name: str, image: Image) -> Localisation:
        """Localise an image ``(H, W, 3)`` uint8 RGB: by the points of all similar places of a street together.

        The pose is supported by two of them, or by very many inliers.

        Raises:
            SequenceError: the image has another shape than its camera.
        """
        view = self._view(image)
        rows = self._index.nearest(view, _PLACES_TRIED)
        if not rows:
            return Localisation(name, reason="no place of the map is similar")
        found = self._best([self._matched(row, view) for row in rows], view)
        if isinstance(found, str):
            return Localisation(name, reason=f"{len(rows)} similar places; {found}")
        away = np.linalg.norm(self._places.T_world_camera[:, :3, 3] - found.T_world_camera[:3, 3], axis=1)
        nearest = self._places.views[int(away.argmin())].index
        return Localisation(name, found.T_world_camera, nearest, found.inliers)

    def _view(self, image: Image) -> View:
        camera = self._intrinsics
        height, width = image.shape[:2]
        if (width, height) != (camera.width, camera.height):
            aspect = width * camera.height / (height * camera.width)
            if not self._resizes or abs(aspect - 1.0) > _ASPECT_TOLERANCE:
                raise SequenceError(
                    f"the image is {width}x{height}, its camera {camera.width}x{camera.height}: give its --camera"
                )
            image = np.asarray(cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA), np.uint8)
        no_depth = np.full(image.shape[:2], np.nan, np.float32)
        return self._features.view(Frame(0, 0.0, image), no_depth)

    def _matched(self, row: int, view: View) -> _Matches:
        place, T_world_place = self._places.views[row], self._places.T_world_camera[row]
        rows_place, rows_view = matches(place, view, self._thresholds)
        points = place.points[rows_place].astype(np.float64)
        known = np.isfinite(points).all(axis=1)
        return _Matches(place.index, T_world_place, apply(T_world_place, points[known]), rows_view[known])

    def _best(self, places: list[_Matches], view: View) -> _Pose | str:
        """The pose with most inliers at one place and those around it that has enough support; or why there is none."""
        best: _Pose | None = None
        reasons = []
        for place in places:
            found = self._resect(place, self._around(place, places), view)
            if isinstance(found, str):
                reasons.append(f"at that of frame {place.frame} {found}")
            elif best is None or found.inliers > best.inliers:
                best = found
        return reasons[0] if best is None else best

    def _around(self, place: _Matches, places: list[_Matches]) -> list[_Matches]:
        """Places no farther away than the points that match here: they show the same street."""
        if not len(place.points_world):
            return [place]
        here = place.T_world_camera[:3, 3]
        reach = float(np.median(np.linalg.norm(place.points_world - here, axis=1)))
        return [other for other in places if np.linalg.norm(other.T_world_camera[:3, 3] - here) <= reach]

    def _resect(self, place: _Matches, around: list[_Matches], view: View) -> _Pose | str:
        """The pose by the points of all these places, supported by two of them or by very many inliers."""
        points_world = np.concatenate([other.points_world for other in around])
        rows_view = np.concatenate([other.rows_view for other in around])
        points = apply(invert(place.T_world_camera), points_world).astype(np.float32)
        found = self._verifier.resect(points, view.pixels[rows_view], _MIN_INLIER_RATIO)
        if isinstance(found, str):
            return found
        owner = np.repeat(np.arange(len(around)), [len(other.rows_view) for other in around])
        supporting = np.bincount(owner[found.resection.inliers]) >= self._thresholds.min_inliers / 2
        inliers = len(np.unique(rows_view[found.resection.inliers]))  # a corner may match at several places
        if supporting.sum() < 2 and inliers < self._thresholds.alone_inliers:
            return f"no second place supports the pose ({inliers} inliers)"
        return _Pose(place.T_world_camera @ invert(found.T_image_points), inliers)


@dataclass(frozen=True)
class _Matches:
    """A place and the points of the world ``(M, 3)`` that match corners of the image, by the rows of these."""

    frame: int
    T_world_camera: FloatArray
    points_world: FloatArray
    rows_view: NDArray[np.intp]


@dataclass(frozen=True)
class _Pose:
    """The pose of the image and its number of inliers."""

    T_world_camera: FloatArray
    inliers: int


def image_paths(images: Path) -> list[Path]:
    """One image, or the images of a folder in their order.

    Raises:
        SequenceError: there are none.
    """
    if images.is_file():
        return [images]
    folder = image_folder(images) if images.is_dir() else None
    if folder is None:
        what = "no images in it" if images.is_dir() else "no such file or folder"
        raise SequenceError(f"{images}: {what}; give an image or a folder of png, jpg or bmp images")
    return list_images(folder)


def _camera_file(explicit: Path | None, images: Path, paths: list[Path]) -> CameraFile | None:
    """That of the user, or else the one that ``run`` would find."""
    if explicit is None:
        folder = images if images.is_dir() else images.parent
        return beside(paths[0].parent, folder, folder.absolute().parent)
    if is_field_of_view(explicit):
        return explicit_camera(explicit, ImageFiles(in_order(paths)))
    return read_explicit(explicit)


def _pinhole(camera: CameraFile) -> Intrinsics:
    return Undistortion(camera).intrinsics if camera.is_distorted else Intrinsics.of(camera.pinhole)
