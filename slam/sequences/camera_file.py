"""Which camera a sequence has: a calibration or a field of view given by the user, or the recording's own.

The keys of ``camera.yaml`` are described in `erfsfm.common.readers.camera_file`. Calibrations of other programs are
read as well: Kalibr, EuRoC, ROS's camera_info YAML, settings of ORB-SLAM and
VINS, COLMAP's cameras.txt. Images of a distorted
lens are undistorted to a pinhole camera, as they are read.
"""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from operator import itemgetter
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from erfsfm.common.config_tree import dump_yaml, parse_yaml
from erfsfm.common.errors import DataError, ErfsfmError
from erfsfm.common.files import read_text
from erfsfm.common.readers.camera_file import (
    CAMERA_FILE,
    CAMERA_WORD,
    UNKNOWN_FOV_DEG,
    UNKNOWN_FX_SIGMA,
    CameraFile,
    Pinhole,
    camera_of,
    is_auto,
    is_line,
    read_camera_file,
)
from erfsfm.common.readers.images import read_image
from slam.frames import DepthMap, Image, Intrinsics, Mask, sampled_depth
from slam.geometry.se3 import FloatArray
from slam.runtime.errors import MissingCameraError, SequenceError
from slam.runtime.files import MASK, write_atomically
from slam.sequences.images import Sized

logger = logging.getLogger(__name__)

DEFAULT_FPS = 10.0
AUTO = Path("auto")
_STATED_FX_SIGMA = 0.1  # relative, by a field of view that the user states
_ORB_COEFFICIENT = re.compile(r"Camera1?\.[kp]\d")
_TABLE = ".txt"  # of COLMAP, which has no keys that tell the program
_FOV_LIMITS_DEG = (3.0, 150.0)

_OF_THE_MOUNTING = ("camera_height_m", "readout_ms", "mask")  # which no calibration knows
_GAPS = np.ones((3, 3), np.uint8)
_BLACK = 128  # grey levels of a mask below which a pixel shows what is fixed to the camera

Keys = dict[str, Any]

# names of a lens by other programs, and the model of camera.yaml
LENSES: dict[str | None, Literal["pinhole", "opencv", "fisheye"]] = {
    **dict.fromkeys(
        ("plumb_bob", "rational_polynomial", "radtan", "radial-tangential", "PinHole"), "opencv"
    ),
    **dict.fromkeys(("equidistant", "fisheye", "KannalaBrandt8"), "fisheye"),
    **dict.fromkeys(("none", "None", "", None, "Rectified"), "pinhole"),
}
_ORB_COEFFICIENTS = {
    "pinhole": (),  # of images that are rectified
    "opencv": ("k1", "k2", "p1", "p2", "k3"),
    "fisheye": ("k1", "k2", "k3", "k4"),
}
# COLMAP: how many focal lengths, and after the principal point how many of k1 k2 p1 p2 k3 ...
_COLMAP = {
    "SIMPLE_PINHOLE": (1, 0),
    "PINHOLE": (2, 0),
    "SIMPLE_RADIAL": (1, 1),
    "RADIAL": (1, 2),
    "OPENCV": (2, 4),
    "OPENCV_FISHEYE": (2, 4),
    "FULL_OPENCV": (2, 8),
}
_VINS_COEFFICIENTS = ("k1", "k2", "p1", "p2")
_LEAST_COEFFICIENTS = 4  # of OpenCV's lens
_NAMELESS = (4, 5, 8)  # coefficients of OpenCV, which files without a name of the lens mean
_ZOOM_STEP = 1.02
_ZOOM_LIMITS = (0.2, 8.0)
_UNLIKELY_ZOOM, _FOLDED_ZOOM = 1.5, 3.0
_CHECK = "check the coefficients and the model in the camera file"


def find_camera_file(
    explicit: Path | None,
    *folders: Path,
    wanted_by: str,
    images: Sized,
    fps: float | None = None,
    own: Callable[[], CameraFile] | None = None,
) -> CameraFile:
    """The camera given by the user, or else the recording's own, or the first ``camera.yaml`` found in ``folders``.

    Args:
        explicit: a ``camera.yaml``, or ``fov=DEGREES`` or ``auto`` and more words (`explicit_camera`).
        folders: where a ``camera.yaml`` may lie; where there is a calibration of the recording's own, it gives the
            height of the camera, its read-out and mask alone.
        wanted_by: what needs it, for the message.
        images: the images that it took, for a camera by its field of view.
        fps: their rate where known, for the same; 10 a second otherwise.
        own: reads the calibration of the recording, where it has one; not called where the user gave another.

    Raises:
        SequenceError: what was given is none; `MissingCameraError` where none was given and none is found.
        DataError: a camera file that is found is malformed.
    """
    if explicit is not None:
        return explicit_camera(explicit, images, fps)
    camera = None if own is None else own()
    found = beside(*folders, own=None if camera is None else camera.model_dump())
    if camera is not None and found is not None:
        return camera.model_copy(update={name: getattr(found, name) for name in _OF_THE_MOUNTING})
    camera = camera or found
    if camera is not None:
        return camera
    places = " and ".join(dict.fromkeys(str(folder) for folder in folders))
    looked = f"looked in {places}; put one there or " if places else ""
    raise MissingCameraError(
        f"no {CAMERA_FILE} for {wanted_by}: {looked}give it with --camera (width, height, fx, fy, cx, cy, fps), or "
        "give the horizontal field of view in degrees, --camera fov=70; run finds it where the camera turns"
    )


def explicit_camera(given: Path, images: Sized, fps: float | None = None) -> CameraFile:
    """The camera that the user named; arguments as in `find_camera_file`.

    That of words on one line, as ``fov=60,height=1.4,fps=15``, is a pinhole with its principal point in the middle and
    square pixels, unless a video says otherwise; without ``fov`` it is what is usual, until the camera is found.

    Raises:
        SequenceError: there is no such file, or the field of view is impossible.
        DataError: the file is malformed, or its lens is unknown.
    """
    if not is_line(given):
        return read_explicit(given, fps)
    matches = [CAMERA_WORD.fullmatch(word) for word in str(given).split(",")]
    values = {match[1]: float(match[2]) for match in matches if match and match[1]}
    fov_deg, fps = values.get("fov", UNKNOWN_FOV_DEG), values.get("fps", fps or DEFAULT_FPS)
    least, most = _FOV_LIMITS_DEG
    if not (all(matches) and least <= fov_deg <= most and fps > 0):
        raise SequenceError(
            f"{given} is no field of view: write fov=70 for 70 degrees from the left edge of the image to the "
            f"right, {least:g} to {most:g}, or auto; and with it, fov=70,height=1.4,fps=30, the metres above the road "
            "and the frames a second"
        )
    width, height = images.width, images.height
    aspect = getattr(images, "pixel_aspect", 1.0)
    if aspect != 1.0:
        logger.warning("pixels are %.3g times as wide as high, as the video says", aspect)
    focal_px = width / 2 / math.tan(math.radians(fov_deg) / 2)
    centre = (width - 1) / 2, (height - 1) / 2
    keys = pinhole_keys(
        width,
        height,
        focal_px,
        aspect * focal_px,
        *centre,
        fps=fps,
        camera_height_m=values.get("height"),
        fx_sigma=UNKNOWN_FX_SIGMA if is_auto(given) else _STATED_FX_SIGMA,
        source=f"a horizontal field of view of {fov_deg:g} degrees",
    )
    return camera_of(keys, str(given))


def read_explicit(path: Path, fps: float | None = None) -> CameraFile:
    """Read the camera file that the user named, ours or of another program; ``fps`` is for one without a rate.

    Raises:
        SequenceError: there is no such file.
        DataError: it is malformed, or its lens is unknown.
    """
    if not path.is_file():
        raise SequenceError(f"no camera file {path}: give a {CAMERA_FILE}, or fov=DEGREES")
    return _read_foreign(path, fps or DEFAULT_FPS) or read_camera_file(path)


def beside(*folders: Path, own: Mapping[str, Any] | None = None) -> CameraFile | None:
    """The first ``camera.yaml`` found in ``folders``, or None; keys that it lacks are those of the ``own`` camera."""
    for folder in folders:
        if (folder / CAMERA_FILE).exists():
            return read_camera_file(folder / CAMERA_FILE, own)
    return None


def require_stated(given: Path | None) -> None:
    """Refuse a camera that has to be found first.

    Raises:
        SequenceError: the user named no file and no field of view.
    """
    if given is not None and is_auto(given):
        raise SequenceError(
            f"--camera {given} finds the camera of a whole recording: give fov=70 here, or the {CAMERA_FILE} of a run"
        )


def _read_foreign(path: Path, fps: float) -> CameraFile | None:
    """The camera of another program's file, of several the first; None where it looks like none of them.

    ``fps`` is for files without a rate. ``DataError``: a number is missing or wrong, or the lens is unknown.
    """
    try:
        is_table = path.suffix == _TABLE
        content = {_TABLE: read_text(path)} if is_table else read_opencv_yaml(path)
    except (OSError, UnicodeDecodeError, ErfsfmError):
        return None  # for the reader of camera.yaml to say what is wrong
    mark = next((mark for mark in _PROGRAMS if isinstance(content, dict) and mark in content), None)
    if mark is None:
        return None
    program, keys_of = _PROGRAMS[mark]
    try:
        keys = keys_of(content)
        keys |= {"fps": keys.get("fps") or fps, "source": f"a calibration of {program}"}
        if keys["model"] != "fisheye" and not any(keys["distortion"]):
            keys |= {"model": "pinhole", "distortion": []}
        return camera_of(keys, str(path))
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise DataError(
            f"{path} looks like a calibration of {program}, but lacks {error}"
        ) from error


def read_opencv_yaml(path: Path) -> Any:
    """The content of a YAML file that OpenCV may have written, whose first line and tags are none of YAML."""
    text = read_text(path)
    return parse_yaml(
        text.partition("\n")[2].replace("!!opencv-matrix", "") if text.startswith("%") else text
    )


def lens_model(
    name: str | None, distortion: Sequence[float]
) -> Literal["pinhole", "opencv", "fisheye"]:
    """The model of ``camera.yaml`` of a lens by another program; without a name 4, 5 or 8 numbers are OpenCV's.

    Raises:
        DataError: it is unknown, or is said to have no distortion, but has ``distortion``.
    """
    if name not in LENSES:
        raise DataError(
            f"the lens model {name} is unknown: known are {', '.join(filter(None, LENSES))}; give --camera"
        )
    model = LENSES[name]
    if model != "pinhole" or not any(distortion):
        return model
    if not name and len(distortion) in _NAMELESS:
        return "opencv"
    raise DataError(
        f"the lens model {name!r} has no distortion, but {len(distortion)} coefficients are there: name their model, "
        "or leave them out"
    )


def pinhole_keys(*pinhole: Any, **more: Any) -> Keys:
    """The keys of ``camera.yaml`` for the values of a `Pinhole`, and ``more`` of them."""
    return vars(Pinhole(*pinhole)) | more


def _kalibr(camera: Keys) -> Keys:
    """Of Kalibr's ``cam0`` or EuRoC's ``sensor.yaml``."""
    _require_pinhole(camera, "camera_model")
    distortion = camera.get("distortion_coeffs") or camera.get("distortion_coefficients") or []
    return pinhole_keys(
        *camera["resolution"],
        *camera["intrinsics"],
        fps=camera.get("rate_hz"),
        model=lens_model(camera.get("distortion_model"), distortion),
        distortion=distortion,
    )


def _camera_info(content: Keys) -> Keys:
    fx, _, cx, _, fy, cy, *_ = content["camera_matrix"]["data"]
    size = content["image_width"], content["image_height"]
    distortion = content.get("distortion_coefficients", {}).get("data", [])
    model = lens_model(content.get("distortion_model"), distortion)
    return pinhole_keys(*size, fx, fy, cx, cy, model=model, distortion=distortion)


def _orb_slam(content: Keys) -> Keys:
    prefix = "Camera1" if "Camera1.fx" in content else "Camera"
    focal = (content[f"{prefix}.{name}"] for name in ("fx", "fy", "cx", "cy"))
    model = lens_model(content.get("Camera.type", "PinHole"), ())
    lens = {key: content[key] for key in content if _ORB_COEFFICIENT.fullmatch(key)}
    known = [f"{prefix}.{name}" for name in _ORB_COEFFICIENTS[model]]
    _refuse_others(lens, known, f"a {model} lens")
    return pinhole_keys(
        content["Camera.width"],
        content["Camera.height"],
        *focal,
        fps=content.get("Camera.fps"),
        model=model,
        distortion=[lens.get(name, 0.0) for name in known],
    )


def _vins(content: Keys) -> Keys:
    _require_pinhole(content, "model_type")
    pinhole = content["projection_parameters"]
    lens = content["distortion_parameters"]
    _refuse_others(lens, _VINS_COEFFICIENTS, "VINS")
    return pinhole_keys(
        content["image_width"],
        content["image_height"],
        *itemgetter("fx", "fy", "cx", "cy")(pinhole),
        model="opencv",
        distortion=[lens[name] for name in _VINS_COEFFICIENTS],
    )


def _require_pinhole(content: Keys, key: str) -> None:
    if str(content.get(key, "pinhole")).lower() != "pinhole":
        raise DataError(f"the {key} {content[key]} is unknown: calibrate as pinhole")


def _refuse_others(lens: Keys, names: Sequence[str], whose: str) -> None:
    if unused := [name for name, value in lens.items() if value and name not in names]:
        raise DataError(f"{', '.join(unused)} of {whose} cannot be used: give a camera.yaml")


def _colmap(content: Keys) -> Keys:
    """Of the first row; COLMAP's (0.5, 0.5) is the centre of the first pixel."""
    lines = content[_TABLE].splitlines()
    rows = [line.split() for line in lines if line.strip() and not line.startswith("#")]
    try:
        _, name, width, height, *words = rows[0]
        if name not in _COLMAP:
            raise DataError(
                f"COLMAP's camera model {name} is unknown: known are {', '.join(_COLMAP)}; fx fy cx cy alone, as of "
                "DROID-SLAM, lack the size of images: give a camera.yaml"
            )
        focal, count = _COLMAP[name]
        fx, *values = map(float, words)
        fy, cx, cy, *distortion = values if focal == 2 else [fx, *values]
        if len(distortion) != count:
            raise ValueError(f"{name} has other parameters")
        distortion += [0.0] * (_LEAST_COEFFICIENTS - count)
        model = "fisheye" if "FISHEYE" in name else "opencv"
        size = int(width), int(height)
        return pinhole_keys(*size, fx, fy, cx - 0.5, cy - 0.5, model=model, distortion=distortion)
    except (IndexError, ValueError) as error:
        raise ValueError("a row 'CAMERA_ID MODEL WIDTH HEIGHT PARAMS...'") from error


_PROGRAMS: dict[str, tuple[str, Callable[[Keys], Keys]]] = {
    _TABLE: ("COLMAP", _colmap),
    "cam0": ("Kalibr", lambda content: _kalibr(content["cam0"])),
    "T_BS": ("EuRoC", _kalibr),
    "camera_matrix": ("ROS", _camera_info),
    "projection_parameters": ("VINS", _vins),
    "Camera.fx": ("ORB-SLAM", _orb_slam),
    "Camera1.fx": ("ORB-SLAM", _orb_slam),
}


class Undistortion:
    """The pinhole camera of a distorted one: same image size, no black borders.

    The new camera keeps the principal point and the ratio fx : fy; its focal length is the shortest one
    whose whole image lies inside the distorted image (OpenCV's ``alpha = 0``, but exact at the border
    and the same for both lens models).
    """

    def __init__(self, camera: CameraFile) -> None:
        pinhole = Intrinsics.of(camera.pinhole)
        self._K = pinhole.K
        self._coefficients = np.asarray(camera.distortion, dtype=np.float64)
        self._model = camera.model
        zoom = self._shortest_zoom(pinhole.pixel_grid())
        if zoom > _FOLDED_ZOOM:
            raise SequenceError(f"distortion {list(camera.distortion)} folds the image: {_CHECK}")
        if zoom > _UNLIKELY_ZOOM:
            text = "distortion %s leaves only the middle %.0f %% of the image's width: %s"
            logger.warning(text, list(camera.distortion), 100 / zoom, _CHECK)
        self.intrinsics = replace(
            pinhole, fx=zoom * camera.fx, fy=zoom * camera.fy, undistorted=True
        )
        pixels = self.intrinsics.pixel_grid()
        seen = self.distort(pixels.reshape(-1, 2), self.intrinsics.K).astype(np.float32)
        map_u, map_v = cv2.split(seen.reshape(pixels.shape))
        self._maps = map_u, map_v

    def apply(self, image: Image) -> Image:
        """Undistort an image ``(H, W, 3)``.

        Raises:
            SequenceError: the image has another size than its camera.
        """
        camera, (height, width) = self.intrinsics, image.shape[:2]
        if (width, height) != (camera.width, camera.height):
            raise SequenceError(
                f"the image is {width}x{height}, its camera {camera.width}x{camera.height}: "
                "give the calibration of this camera at this size"
            )
        return cv2.remap(image, *self._maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

    def apply_to_depth(self, depth: DepthMap) -> DepthMap:
        """Undistort z-depth ``(H, W)`` of an image, not positive or not finite where unknown."""
        return sampled_depth(depth, *self._maps)

    def as_stored(self, mask: Mask) -> Mask:
        """A mask ``(H, W)`` of undistorted images as one of the images as they are stored."""
        stored = np.zeros(mask.shape, np.uint8)
        u, v = (np.rint(each[mask]).astype(int) for each in self._maps)
        stored[v, u] = 1
        # where the lens magnifies, rows and columns are passed over
        return np.asarray(cv2.dilate(stored, _GAPS), np.bool_)

    def distort(self, pixels: FloatArray, K: FloatArray) -> FloatArray:
        """Distorted pixels of the ``pixels`` ``(N, 2)`` of a pinhole ``K`` ``(3, 3)``."""
        rays = (pixels - K[:2, 2]) / K[[0, 1], [0, 1]]
        if self._model == "fov":
            distorted = self._bend(rays) * self._K[[0, 1], [0, 1]] + self._K[:2, 2]
        elif self._model == "fisheye":
            distorted = cv2.fisheye.distortPoints(rays[:, None], self._K, self._coefficients)
        else:
            points = np.column_stack([rays, np.ones(len(rays))])
            distorted, _ = cv2.projectPoints(
                points, np.zeros(3), np.zeros(3), self._K, self._coefficients
            )
        return np.asarray(distorted, dtype=np.float64).reshape(-1, 2)

    def _bend(self, rays: FloatArray) -> FloatArray:
        """The FOV lens (Devernay and Faugeras 2001): radii in the image grow with the angle of a ray."""
        (angle,) = self._coefficients
        radius = np.linalg.norm(rays, axis=1, keepdims=True)
        bent = np.arctan(2 * radius * np.tan(angle / 2)) / angle
        return rays * bent / np.maximum(radius, 1e-12)

    def _shortest_zoom(self, pixels: FloatArray) -> float:
        """Zoom out from the centre until the border of the pixels ``(H, W, 2)`` meets that of the lens's image."""
        border, corner = pixels[[0, -1]].reshape(-1, 2), pixels[-1, -1]
        border = np.concatenate([border, pixels[:, [0, -1]].reshape(-1, 2)])
        zoom, radius = _ZOOM_LIMITS[1], np.zeros(len(border))
        fits = False
        while zoom > _ZOOM_LIMITS[0]:
            K = self._K.copy()
            K[[0, 1], [0, 1]] *= zoom
            seen = self.distort(border, K)
            further = np.linalg.norm(seen - K[:2, 2], axis=1)
            if (further < radius).any() or not ((seen >= 0) & (seen <= corner)).all():
                break
            zoom, radius, fits = zoom / _ZOOM_STEP, further, True
        if not fits:
            raise SequenceError(
                f"distortion {self._coefficients.tolist()} leaves no image free of black borders: {_CHECK}"
            )
        return zoom * _ZOOM_STEP


def require_size(images: Sized, camera: CameraFile, where: str) -> None:
    """Refuse images of another size than their camera.

    Args:
        images: all of one size.
        camera: that took them.
        where: the recording, for the message.

    Raises:
        SequenceError: the sizes differ; the message has the keys of a camera file at the right
            size.
    """
    if (images.width, images.height) == (camera.width, camera.height):
        return
    if (images.width, images.height) == (camera.height, camera.width):
        wanted = "they are turned by a quarter, perhaps by their own metadata: turn them back"
    else:
        scaled = camera.pinhole.resized(images.width, images.height)
        keys = ", ".join(f"{name}: {value:.6g}" for name, value in vars(scaled).items())
        wanted = f"resize the images, or if they were only resized, scale the file to {{{keys}}}"
    raise SequenceError(
        f"the images of {where} are {images.width}x{images.height}, but the camera file is for "
        f"{camera.width}x{camera.height}: {wanted}"
    )


def undistorted(camera: CameraFile) -> tuple[Intrinsics, Undistortion | None]:
    """The camera of images after their distortion is taken out, and what takes it out; None where there is none."""
    lens = Undistortion(camera) if camera.is_distorted else None
    pinhole = Intrinsics.of(camera.pinhole) if lens is None else lens.intrinsics
    return replace(pinhole, readout_s=camera.readout_ms / 1e3, focal_sigma=camera.fx_sigma), lens


def write_camera(folder: Path, camera: CameraFile, fixed: Mask | None) -> None:
    """Write a ``camera.yaml``, and beside it the mask of what is ``fixed`` ``(H, W)`` to the camera, if anything is.

    Raises:
        SequenceError: the disk is full, or the folder is not writable.
    """
    if fixed is not None:
        image = cv2.imencode(".png", np.uint8(255) * ~fixed)[1].tobytes()
        write_atomically(folder / MASK, image, SequenceError)
        camera = camera.model_copy(update={"mask": MASK})
    write_atomically(folder / CAMERA_FILE, dump_yaml(camera), SequenceError)


def fixed_to(camera: CameraFile, undistortion: Undistortion | None) -> Mask | None:
    """Where images ``(H, W)``, undistorted if their lens is distorted, show what is fixed to their camera, by its mask.

    Raises:
        DataError: the image of the mask is missing or broken, or has another size than the camera.
    """
    if camera.mask is None:
        return None
    image = read_image(Path(camera.mask))
    height, width = image.shape[:2]
    if (width, height) != (camera.width, camera.height):
        raise DataError(
            f"mask: {camera.mask} is {width}x{height}, its camera {camera.width}x{camera.height}: draw it on one of "
            "its images"
        )
    image = image if undistortion is None else undistortion.apply(image)
    return image[..., 0] < _BLACK
