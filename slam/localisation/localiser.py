"""Localisation of new images in the map of an old run: image retrieval, then PnP against the points of each place."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from erfsfm.errors import DataError
from erfsfm.readers.camera_file import CameraFile
from erfsfm.readers.folder import image_folder
from erfsfm.readers.images import list_images, read_image
from erfsfm.readers.numbering import by_name
from slam.config import LoopsConfig, load_config
from slam.errors import RunError, SequenceError
from slam.frames import Frame, Image, Intrinsics
from slam.loops.descriptors import FeatureExtractor, View
from slam.loops.places import PLACES, Places
from slam.loops.retrieval import PlaceIndex
from slam.loops.verification import LoopVerifier, matches
from slam.results.folder import RunFolder
from slam.se3 import FloatArray, invert, rotation_angle
from slam.sequences.camera_file import beside, explicit_camera, is_field_of_view, read_explicit
from slam.sequences.images import ImageFiles
from slam.sequences.undistortion import Undistortion

_PLACES_TRIED = 8
_ASPECT_TOLERANCE = 0.01


@dataclass(frozen=True)
class Localisation:
    """The pose ``T_world_camera`` of an image in the unit of the map; or None and the reason."""

    image: str
    T_world_camera: FloatArray | None = None
    nearest_frame: int | None = None
    inliers: int = 0
    reason: str = ""


def localise(images: Path, run: RunFolder, camera: Path | None = None) -> Iterator[Localisation]:
    """Localise images in the map of a run, one after the other.

    Args:
        images: an image or a folder of images.
        run: a finished run with loops switched on.
        camera: their ``camera.yaml``; None for the one beside them, or else the camera of the run.

    Raises:
        SlamError, DataError: no images, no places in the run, or a camera file that does not fit.
    """
    paths = _image_paths(images)
    places = Places.read(run.require(PLACES))
    if not places.views:
        raise RunError(f"{run.path} has no places: it ran with loops.enabled=false; run the sequence again")
    own_camera = _camera_file(camera, paths)
    localiser = Localiser(
        places, load_config(run.path / "config.yaml").loops, None if own_camera is None else _pinhole(own_camera)
    )
    undistortion = Undistortion(own_camera) if own_camera is not None and own_camera.is_distorted else None
    for path in paths:
        try:
            image = read_image(path)
            if undistortion is not None:
                image = undistortion.apply(image)
            yield localiser.locate(path.name, image)
        except (SequenceError, DataError) as error:
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
        self._config = config
        self._resizes = intrinsics is None
        self._intrinsics = intrinsics or places.intrinsics
        self._features = FeatureExtractor(config, self._intrinsics)
        self._verifier = LoopVerifier(config, self._intrinsics)
        self._index = PlaceIndex(places.views, config)

    def locate(self, name: str, image: Image) -> Localisation:
        """Localise an image ``(H, W, 3)`` uint8 RGB: one place with many inliers, or two places that agree on the pose.

        Raises:
            SequenceError: the image has another shape than its camera.
        """
        view = self._view(image)
        rows = self._index.nearest(view, _PLACES_TRIED)
        if not rows:
            return Localisation(name, reason="no place of the map is similar")
        hypotheses: list[_PoseHypothesis] = []
        reasons: list[str] = []
        for row in rows:
            found = self._resect(self._places.views[row], self._places.T_world_camera[row], view)
            if isinstance(found, str):
                reasons.append(found)
            else:
                hypotheses.append(found)
        if not hypotheses:
            return Localisation(name, reason=f"{len(rows)} similar places; at the first, {reasons[0]}")
        best = max(hypotheses, key=lambda hypothesis: hypothesis.inliers)
        support = sum(self._agree(best, other) for other in hypotheses) - 1
        if support == 0 and best.inliers < self._config.alone_inliers:
            reason = f"only the place of frame {best.frame} supports a pose ({best.inliers} inliers)"
            return Localisation(name, reason=reason)
        away = np.linalg.norm(self._places.T_world_camera[:, :3, 3] - best.T_world_camera[:3, 3], axis=1)
        nearest = self._places.views[int(away.argmin())].index
        return Localisation(name, best.T_world_camera, nearest, best.inliers)

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

    def _resect(self, place: View, T_world_place: FloatArray, view: View) -> _PoseHypothesis | str:
        rows_place, rows_view = matches(place, view, self._config)
        if len(rows_place) < self._config.min_inliers:
            return f"only {len(rows_place)} corners match"
        found = self._verifier.resect(place.points[rows_place], view.pixels[rows_view])
        if isinstance(found, str):
            return found
        T_world_camera = T_world_place @ invert(found.T_image_points)
        return _PoseHypothesis(place.index, T_world_camera, found.inliers, found.depth)

    def _agree(self, one: _PoseHypothesis, other: _PoseHypothesis) -> bool:
        T = invert(one.T_world_camera) @ other.T_world_camera
        turned = float(rotation_angle(T[:3, :3]))
        limit = self._config.agreement_ratio * min(one.depth, other.depth)
        return turned < np.deg2rad(self._config.agreement_deg) and float(np.linalg.norm(T[:3, 3])) < limit


@dataclass(frozen=True)
class _PoseHypothesis:
    """The pose of the image by the points of one place: number of inliers and their median ``depth``."""

    frame: int
    T_world_camera: FloatArray
    inliers: int
    depth: float


def _image_paths(images: Path) -> list[Path]:
    if images.is_file():
        return [images]
    folder = image_folder(images) if images.is_dir() else None
    if folder is None:
        what = "no images in it" if images.is_dir() else "no such file or folder"
        raise SequenceError(f"{images}: {what}; give an image or a folder of png, jpg or bmp images")
    return list_images(folder)


def _camera_file(explicit: Path | None, paths: list[Path]) -> CameraFile | None:
    if explicit is None:
        return beside(paths[0].parent)
    if is_field_of_view(explicit):
        return explicit_camera(explicit, ImageFiles(by_name(paths)))
    return read_explicit(explicit)


def _pinhole(camera: CameraFile) -> Intrinsics:
    return Undistortion(camera).intrinsics if camera.is_distorted else Intrinsics.of(camera.pinhole)
