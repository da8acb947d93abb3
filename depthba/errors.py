"""The errors that depthba knows.

Each is one line that names the offender, its value and what was expected.
"""

_LONGEST = 1500
"""Characters of a line that people still read."""


class DepthbaError(Exception):
    """A known error. The command line prints its one line on stderr and exits with status 1."""

    def __str__(self) -> str:
        """Return the line; one that quotes far too much loses its middle."""
        line = super().__str__()
        if len(line) <= _LONGEST:
            return line
        return f"{line[: _LONGEST - 400]} … {line[-400:]}"


class DatasetError(DepthbaError):
    """A dataset breaks the format: names the file, the frame, the value and what was expected."""


class OptionError(DepthbaError):
    """An option has a value that makes no sense, alone or for this dataset."""


class RunError(DepthbaError):
    """A run folder is missing, in the way, or not whole."""


class MissingPackage(DepthbaError):
    """An optional package is not installed: names the package and the extra that brings it."""


class OutOfReach(DepthbaError):
    """An arm cannot take a pose, or cannot come there on the way asked for."""


class Unsolvable(DepthbaError):
    """The equations have no solution in double precision: lengths that no scene has, as a rule."""


class Cancelled(DepthbaError):
    """The caller asked to stop; nothing was returned or written."""
