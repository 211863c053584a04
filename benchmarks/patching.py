"""Putting wrappers around functions and methods of regnet_core from outside, by name, and taking them off again.

A function is replaced wherever a loaded module of ours refers to it, so that it does not matter which module imported
it from where.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from contextlib import ExitStack
from types import ModuleType
from typing import Any, NamedTuple

from benchmarks.errors import StageError

Function = Callable[..., Any]
_OURS = ("regnet_core", "regnet_ros", "benchmarks")


class Target(NamedTuple):
    """Something that can be wrapped."""

    owner: Any
    """The module or class that defines it."""
    attribute: str
    function: Function


def resolve(name: str) -> Target:
    """Find a function by a name such as ``regnet_core.pointcloud:crop`` or ``regnet_core.nn.heads:ScoreHead.forward``.

    Raises:
        StageError: there is no such module, function or method.
    """
    module_name, _, path = name.partition(":")
    *classes, attribute = path.split(".")
    try:
        owner: Any = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        if not (error.name or "").startswith(_OURS):
            raise
        raise StageError(f"there is no module {error.name} any more, where the benchmarks look for {name}") from error
    for part in classes:
        owner = vars(owner).get(part)
        if owner is None:
            raise StageError(f"{module_name} has no {part} any more, where the benchmarks look for {name}")
    function = vars(owner).get(attribute)
    if not callable(function):
        raise StageError(f"{module_name} has no function {path} any more, which the benchmarks measure")
    return Target(owner, attribute, function)


def replace(stack: ExitStack, target: Target, replacement: Function) -> None:
    """Put something in the place of a function until the stack is closed."""
    if not isinstance(target.owner, ModuleType):
        _set(stack, target.owner, target.attribute, replacement)
        return
    for module in list(sys.modules.values()):
        if isinstance(module, ModuleType) and module.__name__.partition(".")[0] in _OURS:
            for attribute in [key for key, value in vars(module).items() if value is target.function]:
                _set(stack, module, attribute, replacement)


def _set(stack: ExitStack, owner: Any, attribute: str, value: Any) -> None:
    stack.callback(setattr, owner, attribute, vars(owner)[attribute])
    setattr(owner, attribute, value)
