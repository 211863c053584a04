"""Clear words where a subcommand needs packages that plain detection does not."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from regnet_core.errors import InvalidInputError


@contextmanager
def needs(command: str, extra: str) -> Iterator[None]:
    """Turn a failed import into a message that names the extra to install.

    Raises:
        InvalidInputError: a package is missing.
    """
    try:
        yield
    except ImportError as error:
        if (error.name or "").startswith("regnet_core"):
            raise
        if isinstance(error, ModuleNotFoundError):
            reason = f"the package {error.name}; pip install 'regnet_ros[{extra}]' brings it"
        else:  # a shared library of the system, such as libGL.so.1
            reason = f"something that the system lacks: {error}"
        raise InvalidInputError(f"`regnet {command}` needs {reason}") from error
