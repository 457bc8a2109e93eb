"""The inputs of a run: the options of the verbs ``run`` and ``live``, and the arguments of `slam.run_slam`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BeforeValidator, Field, ValidationError

from erfsfm.common.config_tree import Section, first_problem
from erfsfm.common.progress import Progress, silent
from slam.runtime.errors import RunError
from slam.runtime.storage.files import from_anywhere

NameOrPath = Annotated[str, BeforeValidator(lambda given: str(given) if isinstance(given, Path) else given)]

_RECORDING = ("dataset", "camera", "gps", "sequence", "frames", "truth")


class Request(Section):
    """The inputs that every run has, as ``erfsfm-slam run --help`` explains them; from Python, a path may be text.

    Attributes:
        command: recorded in the metrics.
    """

    camera: Path | None = None
    weights: NameOrPath = "default"
    config: NameOrPath | None = None
    overrides: list[str] | None = None
    output: Path | None = None
    seed: int = Field(default=0, ge=0, lt=2**31)
    device: Literal["auto", "cpu", "cuda"] = "auto"
    command: str = "slam.run_slam"

    @classmethod
    def of(cls, **arguments: Any) -> Self:
        """The request of arguments given by name.

        Raises:
            TypeError: an unknown argument.
            RunError: a value of another kind.
        """
        if unknown := arguments.keys() - cls.model_fields.keys():
            names = ", ".join(name for name in cls.model_fields if name != "command")
            raise TypeError(f"run_slam has no argument {', '.join(sorted(unknown))}; it has {names}")
        try:
            return cls(**arguments)
        except ValidationError as error:
            raise RunError(f"run_slam: {first_problem(error)}") from error

    @property
    def recording(self) -> dict[str, str]:
        """The options that name the recording, files by their whole paths; none of the embedded street."""
        given = {name: getattr(self, name, None) for name in _RECORDING}
        named = {name: value for name, value in given.items() if value is not None}
        return {name: from_anywhere(v) if name == "dataset" or isinstance(v, Path) else v for name, v in named.items()}


class RunRequest(Request):
    """Also the recording and what is written of it; without ``dataset`` and ``sequence`` the embedded street.

    Attributes:
        progress: called with (stage, done, total).
    """

    dataset: Path | None = None
    sequence: str | None = None
    frames: str | None = None
    truth: Path | None = None
    rerun: Path | None = None
    gps: Path | None = None
    progress: Progress = silent
