"""Policy files: the constants of the analytic policy for a robot, and where they come from.

A file is YAML, such as

    policy: analytic
    constants: {quality_gain: 0.8783, quality_offset: -0.0587, slope: 10.1244, midpoint: 0.6103}
    errors: {slope: 0.2}
    origin: {robot: Baxter, samples: 20000}

`errors` are standard errors of the constants and may be left out, in part or wholly; so may `origin`, which says how
the constants were found and is for people. The files of this folder are known by their names.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import yaml

from regnet_core.checks import is_number
from regnet_core.errors import InvalidInputError
from regnet_core.policy import AnalyticPolicy

SUFFIX = ".yaml"
CONSTANTS = tuple(f.name for f in fields(AnalyticPolicy))
"""Names of the constants, in their order."""
_FOLDER = Path(__file__).parent
_KEYS = ("policy", "constants", "errors", "origin")
_LARGEST = 100_000
"""No policy file is larger [byte]."""


@dataclass(frozen=True)
class PolicyFile:
    """What a policy file holds."""

    policy: AnalyticPolicy
    errors: Mapping[str, float] = field(default_factory=dict)
    """Standard errors of the constants, where they are known."""
    origin: Mapping[str, Any] = field(default_factory=dict)
    """How the constants were found: plain values that YAML can write."""

    def __post_init__(self) -> None:
        """Check the errors.

        Raises:
            InvalidInputError: one is not of a constant, or not a finite number of at least 0.
        """
        for name, value in self.errors.items():
            if name not in CONSTANTS:
                raise InvalidInputError(f"errors are of the constants {', '.join(CONSTANTS)}; got one of {name!r}")
            if not is_number(value) or not 0.0 <= value < math.inf:
                raise InvalidInputError(f"the error of {name} must be a finite number of at least 0, got {value!r}")


def policy_names() -> tuple[str, ...]:
    """The policy files of this folder, by name."""
    return tuple(sorted(path.stem for path in _FOLDER.glob(f"*{SUFFIX}")))


def load_policy(name: str | Path) -> PolicyFile:
    """Read a policy file.

    Args:
        name: one of `policy_names()`, or the path of a file that ends in .yaml.

    Raises:
        InvalidInputError: there is no such file, or it is no policy file; the message says what is wrong with it.
    """
    path = Path(name).expanduser()
    if str(name) in policy_names():
        path = _FOLDER / f"{name}{SUFFIX}"
    elif path.suffix != SUFFIX:
        raise InvalidInputError(
            f"no policy file '{name}'; there are {', '.join(policy_names())}, or the path of a {SUFFIX} file"
        )
    if not path.is_file():
        raise InvalidInputError(f"there is no policy file '{path}'")
    try:
        with path.open(encoding="utf-8") as stream:
            content = yaml.safe_load(stream.read(_LARGEST))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise InvalidInputError(f"the policy file '{path}' is no YAML: {' '.join(str(error).split())}") from error
    try:
        return _parsed(content)
    except InvalidInputError as error:
        raise InvalidInputError(f"policy file '{path}': {error}") from error


def save_policy(path: str | Path, file: PolicyFile) -> None:
    """Write a policy file.

    Raises:
        InvalidInputError: the path does not end in .yaml.
    """
    path = Path(path)
    if path.suffix != SUFFIX:
        raise InvalidInputError(f"a policy file's name must end in {SUFFIX}, got '{path.name}'")
    content: dict[str, Any] = {"policy": AnalyticPolicy.name}
    content["constants"] = {name: float(getattr(file.policy, name)) for name in CONSTANTS}
    if file.errors:
        content["errors"] = {name: float(file.errors[name]) for name in CONSTANTS if name in file.errors}
    if file.origin:
        content["origin"] = dict(file.origin)
    path.write_text(yaml.safe_dump(content, sort_keys=False, allow_unicode=True, width=120), encoding="utf-8")


def _parsed(content: Any) -> PolicyFile:
    if not isinstance(content, dict):
        raise InvalidInputError(f"it must be a mapping with the keys policy and constants, got {content!r:.80}")
    unknown = [key for key in content if key not in _KEYS]
    if unknown:
        raise InvalidInputError(f"unknown key {unknown[0]!r}; the keys are {', '.join(_KEYS)}")
    if content.get("policy") != AnalyticPolicy.name:
        raise InvalidInputError(f"policy must be {AnalyticPolicy.name!r}, got {content.get('policy')!r}")
    constants = _mapping(content, "constants")
    if set(constants) != set(CONSTANTS):
        raise InvalidInputError(f"constants must be {', '.join(CONSTANTS)}, got {', '.join(map(str, constants))}")
    return PolicyFile(AnalyticPolicy(**constants), _mapping(content, "errors"), _mapping(content, "origin"))


def _mapping(content: Mapping[str, Any], key: str) -> dict[str, Any]:
    value = content.get(key, {})
    if not isinstance(value, dict):
        raise InvalidInputError(f"{key} must be a mapping, got {value!r:.80}")
    return value
