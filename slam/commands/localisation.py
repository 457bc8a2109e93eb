"""Localisation of new images in the map of an old run: image retrieval, then PnP against the points of each place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.distance import cdist

from erfsfm.common.errors import DataError
from erfsfm.common.progress import Progress, silent
from erfsfm.common.readers.camera_file import CAMERA_FILE, read_camera_file
from erfsfm.common.readers.images import images_at, read_image
from erfsfm.common.readers.numbering import in_order
from erfsfm.common.table import DASH, Table
from slam.formats.trajectory import Trajectory, write_kitti, write_tum
from slam.frames import Frame, Image, Intrinsics, Mask, View
from slam.geometry.multiview import Resection, consensus, pixel_jacobian, resect
from slam.geometry.robust import mad_sigma, median
from slam.geometry.se3 import FloatArray, Rows, apply, invert, length_of
from slam.loops.features import FeatureExtractor, hamming
from slam.loops.places import Places, PlaceStructure
from slam.loops.verification import OF_FRAMES, OF_KEYFRAMES, matches
from slam.loops.vocabulary import PlaceIndex
from slam.results.folder import RunFolder
from slam.runtime.errors import RunError, SequenceError
from slam.runtime.files import PLACES
from slam.sequences.camera_file import (
    beside,
    explicit_camera,
    fixed_to,
    require_stated,
    undistorted,
)
from slam.sequences.images import ImageFiles
from slam.sequences.recording import frame_range

_PLACES_TRIED = 8
_STARTS = 3  # of these are refined
_PLACES_AROUND = 12  # around the pose, whose points are looked for in the image
# bits of descriptors where the pose is known: less sure matches pull it towards itself
_MOST_DIFFERING = 50
_SAMPLES = 300  # of RANSAC
_LEAST_POINTS = 8  # of a place, to try it
_LEAST_INLIERS = 30
_LEAST_RATIO = 0.5
_MOST_SIGMA = 0.01  # of the position, over the depth of the points
# of the focal length, beyond which the image is by another lens: corners show one that is a tenth longer
# as 5 to 9 %, and their own to 1 %
_LONGER = 0.02
_ASPECT_TOLERANCE = 0.01


@dataclass(frozen=True)
class Localisation:
    """The pose ``T_world_camera`` of an image in the unit of the map; or None and the reason.

    ``number`` is that of the image among those of its folder.
    """

    image: str = ""
    T_world_camera: FloatArray | None = None
    nearest_frame: int | None = None
    inliers: int = 0
    reason: str = ""
    number: int = 0

    def tree(self) -> dict[str, Any]:
        """For JSON: unknown values are null, with the reason."""
        T_world_camera = self.T_world_camera
        if T_world_camera is None:
            unknown = dict.fromkeys(("position", "T_world_camera", "nearest_frame", "inliers"))
            return {"image": self.image, "found": False, **unknown, "reason": self.reason}
        return {
            "image": self.image,
            "found": True,
            "position": T_world_camera[:3, 3].tolist(),
            "T_world_camera": T_world_camera.tolist(),
            "nearest_frame": self.nearest_frame,
            "inliers": self.inliers,
        }


def localise(
    images: Path,
    run: RunFolder,
    camera: Path | None = None,
    frames: str | None = None,
    every: int = 1,
    progress: Progress = silent,
) -> list[Localisation]:
    """Localise images in the map of a run, one after the other.

    Args:
        images: an image or a folder of images.
        run: a finished run with loops switched on.
        camera: their ``camera.yaml``; None for the one beside them or their folder, or else the camera of the run.
        frames: ``A:B``, half-open, of the images in their order; None for all.
        every: of these, every n-th.
        progress: is told how many images are done.

    Raises:
        SlamError, DataError: no images or none that can be read, no places in the run, a camera file that does not fit,
            or none where the run undistorted its images.
    """
    require_stated(camera)
    paths = images_at(images)
    first, last = frame_range(frames or ":", len(paths))
    places = Places.read(run.require(PLACES))
    if not places.views:
        raise RunError(
            f"{run.path} has no places: it ran with loops.enabled=false; run the sequence again"
        )
    if camera is None:
        folder = images if images.is_dir() else images.parent
        # where ``run`` looks
        own_camera = beside(paths[0].parent, folder, folder.absolute().parent)
    else:
        own_camera = explicit_camera(camera, ImageFiles(in_order(paths)))
    of_run = run.path / CAMERA_FILE
    if is_of_run := own_camera is None and of_run.is_file():
        own_camera = read_camera_file(of_run)
    if own_camera is None and places.intrinsics.undistorted:
        raise SequenceError(
            f"{run.path} undistorted its images, and {images} has no {CAMERA_FILE}: give its --camera, which is fov=70 "
            "for images without distortion"
        )
    intrinsics = undistortion = fixed = None
    if own_camera is not None:
        intrinsics, undistortion = undistorted(own_camera)
        fixed = fixed_to(own_camera, undistortion)
    localiser = Localiser(places, None if is_of_run else intrinsics, fixed)
    numbers, found, unreadable = range(first, last, every), [], 0
    for number in numbers:
        name = paths[number].name
        try:
            image = read_image(paths[number])
            image = image if undistortion is None else undistortion.apply(image)
            found.append(replace(localiser.locate(name, image), number=number))
        except (DataError, SequenceError) as error:
            unreadable += isinstance(error, DataError)
            if unreadable == len(numbers):
                raise  # not one of them is an image
            found.append(Localisation(name, reason=str(error), number=number))
        progress("images", len(found), len(numbers))
    return found


def localisation_table(found: Sequence[Localisation]) -> Table:
    """One row an image: position in the map, nearest frame of the run, inliers; below, why one is not found."""
    rows = []
    for each in found:
        row = [each.image, *[DASH] * 5]
        if each.T_world_camera is not None:
            position = (f"{value:.2f}" for value in each.T_world_camera[:3, 3])
            row[1:] = [*position, str(each.nearest_frame), str(each.inliers)]
        rows.append(row)
    notes = [
        f"{each.image} not found: {each.reason}" for each in found if each.T_world_camera is None
    ]
    head = ["image", "x", "y", "z", "nearest\nframe", "inliers"]
    return Table(head, rows, f"{len(found) - len(notes)} of {len(found)} images found", notes)


def write_localisations(path: Path, found: Sequence[Localisation]) -> None:
    """Write the poses found: as TUM, or after the number of their frame as KITTI where the name ends in ``.kitti``.

    The stamp, or number, is that of the image.
    """
    poses = {each.number: each.T_world_camera for each in found if each.T_world_camera is not None}
    if not poses:
        raise RunError(f"none of {len(found)} images was found in the map: {path} is not written")
    write = write_kitti if path.suffix == ".kitti" else write_tum
    write(
        path,
        Trajectory(
            np.array(list(poses), dtype=np.float64), np.stack(list(poses.values())), numbered=True
        ),
    )


class Localiser:
    """Localises single images among the places of one run; no network is used."""

    def __init__(
        self, places: Places, intrinsics: Intrinsics | None = None, fixed: Mask | None = None
    ) -> None:
        """``intrinsics`` are of the new images; without any they are resized to those of the run.

        ``fixed`` ``(h, w)`` is True where they show what is fixed to their camera.
        """
        self._places = places
        self._thresholds = replace(OF_FRAMES, max_hamming=OF_KEYFRAMES.max_hamming)
        self._resizes, self._fixed = intrinsics is None, fixed
        self._intrinsics = intrinsics or places.intrinsics
        self._features = FeatureExtractor(self._intrinsics)
        self._structure = PlaceStructure(places, self._thresholds)
        self._index = PlaceIndex(places.views)

    def locate(self, name: str, image: Image) -> Localisation:
        """Localise an image ``(H, W, 3)`` uint8 RGB: at similar places, then in the map around.

        Points of learned depth are used beside triangulated ones where both agree, else only if these are too few.

        Raises:
            SequenceError: the image has another shape than its camera.
        """
        view = self._view(image)
        rows = self._index.nearest(view, _PLACES_TRIED)
        if not rows:
            return Localisation(name, reason="no place of the map is similar")
        learned = self._structure.confirms_depth(rows)
        found = self._found(rows, view, learned)
        if not found.inliers:
            found = self._found(rows, view, not learned)
        if found.T_world_camera is None:
            return Localisation(name, reason=f"{len(rows)} similar places; {found.reason}")
        away = np.linalg.norm(
            self._places.T_world_camera[:, :3, 3] - found.T_world_camera[:3, 3], axis=1
        )
        return replace(
            found, image=name, nearest_frame=self._places.views[int(away.argmin())].index
        )

    def _view(self, image: Image) -> View:
        camera = self._intrinsics
        height, width = image.shape[:2]
        if (width, height) != (camera.width, camera.height):
            aspect = width * camera.height / (height * camera.width)
            if not self._resizes or abs(aspect - 1.0) > _ASPECT_TOLERANCE:
                raise SequenceError(
                    f"the image is {width}x{height}, its camera {camera.width}x{camera.height}: give its --camera"
                )
        frame = Frame(0, 0.0, image, self._fixed).resized(camera.width, camera.height)
        return self._features.view(frame, np.full(frame.grey.shape, np.nan, np.float32))

    def _found(self, rows: list[int], view: View, learned: bool) -> Localisation:
        """The pose with most corners of the map around it, of those by the places with most inliers; or why not."""
        starts = [start for row in rows if len((start := self._start(row, view, learned))[1])]
        starts.sort(key=lambda start: len(start[1]), reverse=True)
        found = [
            self._refined(T_camera_world, rows, view, learned)
            for T_camera_world, _ in starts[:_STARTS]
        ]
        nowhere = Localisation(reason="no place has corners that fit one pose")
        return max(found, key=lambda each: each.inliers, default=nowhere)

    def _refined(
        self, T_camera_world: FloatArray, rows: list[int], view: View, learned: bool
    ) -> Localisation:
        """The pose by all corners of the map around a first one; or why it is none."""
        for widening in (4.0, 2.0, 1.0):
            radius_px = widening * self._thresholds.reprojection_px
            points, pixels = self._around(T_camera_world, rows, view, learned, radius_px)
            if len(points) < self._thresholds.min_inliers:
                return Localisation(reason=f"only {len(points)} corners agree")
            pose = resect([T_camera_world], points, pixels, self._intrinsics.K)
            T_camera_world = pose.T_camera_world
        inliers = pose.residual_px < self._thresholds.reprojection_px
        count = int(inliers.sum())
        if count < max(_LEAST_INLIERS, _LEAST_RATIO * len(inliers)):
            return Localisation(reason=f"only {count} of {len(inliers)} corners agree")
        points, pixels = points[inliers], pixels[inliers]
        depth = median(apply(T_camera_world, points)[:, 2])
        sigma = length_of(pose.sigmas[3:]) / depth
        if sigma > _MOST_SIGMA:
            return Localisation(
                reason=f"{count} corners agree, but give the position to {sigma:.1%} of their depth"
            )
        longer, sigma = _longer(pose, points, pixels, self._intrinsics)
        if abs(longer) > _LONGER + 3.0 * sigma:
            times = f"{np.exp(longer):.2f} times the focal length of its camera"
            reason = f"{count} corners agree, but want {times}: give its --camera"
            return Localisation(reason=reason, inliers=count)
        return Localisation(T_world_camera=invert(T_camera_world), inliers=count)

    def _start(self, row: int, view: View, learned: bool) -> tuple[FloatArray, Rows]:
        """The pose by one place, as `consensus` gives it."""
        corners, seen = matches(self._places.views[row], view, self._thresholds)
        points = self._structure.points(row, learned)[corners]
        known = np.isfinite(points).all(axis=1)
        if known.sum() < _LEAST_POINTS:
            return np.eye(4), corners[:0]
        pixels = view.pixels[seen[known]].astype(np.float64)
        return consensus(
            points[known], pixels, self._intrinsics.K, _SAMPLES, self._thresholds.reprojection_px
        )

    def _around(
        self,
        T_camera_world: FloatArray,
        rows: list[int],
        view: View,
        learned: bool,
        radius_px: float,
    ) -> tuple[FloatArray, FloatArray]:
        """Points ``(M, 3)`` of the map that look like corners ``(M, 2)`` of the image near where they project."""
        centre = invert(T_camera_world)[:3, 3]
        away = np.linalg.norm(self._places.T_world_camera[:, :3, 3] - centre, axis=1)
        near = sorted({*rows, *np.argsort(away)[:_PLACES_AROUND].tolist()})
        points = np.concatenate([self._structure.points(row, learned) for row in near])
        X = apply(T_camera_world, points)
        ahead = X[:, 2] > 0  # false of unknown ones
        if not ahead.any() or not len(view):
            return np.zeros((0, 3)), np.zeros((0, 2))
        points, seen = points[ahead], self._intrinsics.project(X[ahead])
        descriptors = np.concatenate([self._places.views[row].descriptors for row in near])[ahead]
        differing = hamming(view.descriptors, descriptors)
        differing[cdist(view.pixels, seen) > radius_px] = np.inf
        best = differing.argmin(axis=1)
        corners = np.flatnonzero(differing[np.arange(len(view)), best] <= _MOST_DIFFERING)
        return points[best[corners]], view.pixels[corners].astype(np.float64)


def _longer(
    pose: Resection, points: FloatArray, pixels: FloatArray, camera: Intrinsics
) -> tuple[float, float]:
    """By how much a focal length that is free beside the pose is longer, as a logarithm, and its sigma."""
    X = apply(pose.T_camera_world, points)
    seen = camera.project(X)
    by_focal = (seen - (camera.cx, camera.cy)).T[None]
    by_pose = pixel_jacobian(X, np.array([camera.fx, camera.fy]))
    J, residual = np.concatenate([by_pose, by_focal]).reshape(7, -1), (pixels - seen).T.ravel()
    covariance = np.linalg.inv(J @ J.T)
    return float(covariance[6] @ J @ residual), mad_sigma(residual) * float(covariance[6, 6]) ** 0.5
