"""A calibration in one picture: where the board was seen, how well it fits, and an image before and after."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from erfsfm.common.files import save_figure
from erfsfm.common.readers.camera_file import CameraFile
from slam.commands.calibration.solve import Calibration
from slam.sequences.images import ImageSource
from slam.sequences.undistortion import Undistortion

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_SIZE_INCHES, _DPI = (13.0, 9.5), 100
_ARROW_LENGTH = 0.05  # of the image's width, of an error as large as the root mean square


def write_picture(path: Path, fit: Calibration, camera: CameraFile, images: ImageSource) -> None:
    """Draw a fit: an image with corners and residuals, all corners, all residuals, the image undistorted.

    Raises:
        ConfigError, OSError: it cannot be written, or another image is there.
        DataError, SequenceError: the image cannot be read again.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=_SIZE_INCHES, dpi=_DPI, layout="constrained")
    axes = figure.subplots(2, 2)
    view = int(np.argmax([each.sharpness for each in fit.views]))
    image = images.read(fit.views[view].frame)
    _draw_view(axes[0, 0], fit, view, image)
    _draw_coverage(axes[0, 1], fit)
    _draw_residuals(axes[1, 0], fit)
    axes[1, 1].imshow(Undistortion(camera).apply(image) if camera.is_distorted else image)
    axes[1, 1].set_title(f"image {fit.views[view].frame} undistorted: edges of the board must be straight")
    for axis in (axes[0, 0], axes[0, 1], axes[1, 1]):
        axis.set_xticks([])
        axis.set_yticks([])
    save_figure(figure, path, _DPI)


def _draw_view(axis: Axes, fit: Calibration, view: int, image: np.ndarray[tuple[int, ...], np.dtype[np.uint8]]) -> None:
    pixels, residuals = fit.views[view].pixels, fit.residuals[view]
    longer = _ARROW_LENGTH * fit.width / max(fit.error_px, 1e-9)
    axis.imshow(image)
    u, v = pixels.T
    axis.plot(u, v, "+", color="#0072b2", markersize=7)
    du, dv = longer * residuals.T
    axis.quiver(u, v, du, dv, angles="xy", scale_units="xy", scale=1.0, color="#d55e00", width=0.003)
    axis.set_title(f"image {fit.views[view].frame}: corners, and residuals {longer:.0f} times as long")


def _draw_coverage(axis: Axes, fit: Calibration) -> None:
    u, v = np.concatenate([view.pixels for view in fit.views]).T
    errors = np.concatenate([np.linalg.norm(r, axis=1) for r in fit.residuals])
    shown = axis.scatter(u, v, c=errors, s=7, cmap="viridis", vmin=0, vmax=float(np.quantile(errors, 0.99)))
    axis.set(xlim=(-0.5, fit.width - 0.5), ylim=(fit.height - 0.5, -0.5), aspect="equal")
    axis.set_title(f"all corners of {len(fit.views)} views: {100 * fit.covered:.0f} % of the image")
    axis.figure.colorbar(shown, ax=axis, label="error, pixels", shrink=0.8)


def _draw_residuals(axis: Axes, fit: Calibration) -> None:
    u, v = np.concatenate(fit.residuals).T
    limit = 1.1 * float(max(np.abs(u).max(), np.abs(v).max()))
    axis.scatter(u, v, s=6, color="#0072b2", alpha=0.5)
    axis.set(xlim=(-limit, limit), ylim=(-limit, limit), aspect="equal", xlabel="u, pixels", ylabel="v, pixels")
    axis.axhline(0, color="#888888", linewidth=0.7)
    axis.axvline(0, color="#888888", linewidth=0.7)
    axis.set_title(f"residuals: {fit.error_px:.3f} pixels root mean square")
