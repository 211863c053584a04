"""What goes wrong in a benchmark itself, rather than in what it measures."""

from regnet_core.errors import RegnetError


class BenchmarkError(RegnetError):
    """The measurement cannot be made or cannot be trusted; the message says why and what to do."""


class StageError(BenchmarkError):
    """The table of stages does not fit the code any more."""
