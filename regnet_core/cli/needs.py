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
    except ModuleNotFoundError as error:
        if (error.name or "").startswith("regnet_core"):
            raise
        raise InvalidInputError(
            f"`regnet {command}` needs the package {error.name}; pip install 'regnet_ros[{extra}]' brings it"
        ) from error
