"""The inputs of a run: the options of the verb ``run`` and the arguments of `slam.run_slam`."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from erfsfm.common.progress import Progress
from slam.runtime.errors import RunError
from slam.runtime.storage.files import from_anywhere

if TYPE_CHECKING:
    from slam.results.metrics import Recording

_RECORDING = ("dataset", "camera", "gps", "sequence", "frames", "truth")
_TEXTS = ("weights", "config")  # names, or paths
LARGEST_SEED = 2**31 - 1


@dataclass(frozen=True)
class RunRequest:
    """All inputs of a run, as ``erfsfm-slam run --help`` explains them.

    Without ``dataset`` and ``sequence`` the embedded simulated street is run. From Python, a path may be text.

    Attributes:
        progress: called with (stage, done, total).
        command: recorded in the metrics.
    """

    dataset: Path | None = None
    sequence: str | None = None
    camera: Path | None = None
    weights: str = "default"
    config: str | None = None
    overrides: list[str] | None = None
    frames: str | None = None
    truth: Path | None = None
    output: Path | None = None
    rerun: Path | None = None
    gps: Path | None = None
    seed: int = 0
    device: Literal["auto", "cpu", "cuda"] = "auto"
    progress: Progress | None = None
    command: str = "slam.run_slam"

    @classmethod
    def of(cls, **arguments: Any) -> RunRequest:
        """The request of arguments given in Python, or read from a file.

        Raises:
            TypeError: an unknown argument.
            RunError: a value of another kind.
        """
        from pydantic import TypeAdapter, ValidationError  # takes as long to import as the rest of the command line

        from erfsfm.common.config_tree import first_problem

        unknown = arguments.keys() - {field.name for field in fields(cls)}
        if unknown:
            names = ", ".join(field.name for field in fields(cls) if field.name != "command")
            raise TypeError(f"run_slam has no argument {', '.join(sorted(unknown))}; it has {names}")
        arguments |= {key: str(arguments[key]) for key in _TEXTS if isinstance(arguments.get(key), Path)}
        try:
            request = TypeAdapter(cls).validate_python(arguments)
        except ValidationError as error:
            raise RunError(f"run_slam: {first_problem(error)}") from error
        if not 0 <= request.seed <= LARGEST_SEED:
            raise RunError(f"run_slam: seed: should be from 0 to {LARGEST_SEED}; got {request.seed}")
        return request

    @property
    def recording(self) -> Recording:
        """The options that name the recording, files by their whole paths."""
        from slam.results.metrics import Recording

        given = {name: getattr(self, name) for name in _RECORDING}
        texts = {
            name: from_anywhere(value) if isinstance(value, Path) else value
            for name, value in given.items()
            if value is not None
        }
        return Recording.of(**texts)
