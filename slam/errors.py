"""The errors a user can cause; the command line prints them as one line and exits with 1."""


class SlamError(Exception):
    """Base of every known error of the SLAM package."""


class ConfigError(SlamError):
    """A configuration file or option is wrong."""


class SequenceError(SlamError):
    """A sequence is missing, incomplete or malformed."""


class MissingFrameError(SequenceError):
    """A frame of a sequence has no image: a gap in time, which is interpolated."""


class TrajectoryError(SlamError):
    """A trajectory file cannot be read, or two trajectories do not match."""


class RunError(SlamError):
    """A run folder is missing or incomplete."""
