"""The errors a user can cause; the command line prints them as one line and exits with 1."""


class ErfsfmError(Exception):
    """Base of every known error of the network package."""


class ConfigError(ErfsfmError):
    """A configuration, preset name or option is wrong."""


class CheckpointError(ErfsfmError):
    """Weights are missing, damaged, or of another architecture."""


class DataError(ErfsfmError):
    """A data set is missing, incomplete or malformed."""


class TrainingError(ErfsfmError):
    """Training cannot start or continue."""


class ExportError(ErfsfmError):
    """A network cannot be written in another format."""
