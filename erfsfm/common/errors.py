"""The errors a user can cause; the command line prints them as one line and exits with 1."""

COUNTED = {"counted": True}  # ``extra`` of a warning whose number tells more than each of them
_LONGEST = 700
_LAST = 200
_OF_WORKER = "Original Traceback (most recent call last)"


OUT_OF_MEMORY = (
    "memory ran out; what was written stays: use fewer frames or smaller images, or a machine with more memory"
)


def one_line(text: str) -> str:
    """A message without line breaks; the middle of a very long one is left out.

    Of an error of a data loader's process, to which PyTorch adds its traceback, only the message stays.
    """
    if _OF_WORKER in text:
        text = text.strip().splitlines()[-1].partition(": ")[2]
    line = " ".join(text.splitlines())
    return line if len(line) <= _LONGEST else f"{line[: _LONGEST - _LAST]} ... {line[-_LAST:]}"


class OneLineError(Exception):
    """An error whose text is one line of bounded length, whatever a damaged file puts into it."""

    def __str__(self) -> str:
        return one_line(super().__str__())


class ErfsfmError(OneLineError):
    """Base of every known error of the network package."""


class ConfigError(ErfsfmError):
    """A configuration, preset name or option is wrong."""


class BusyError(ErfsfmError):
    """Another process writes to a folder."""


class CheckpointError(ErfsfmError):
    """Weights are missing, damaged, or of another architecture."""


class DataError(ErfsfmError):
    """A data set is missing, incomplete or malformed."""


class TrainingError(ErfsfmError):
    """Training cannot start or continue."""


class ExportError(ErfsfmError):
    """A network cannot be written in another format."""
