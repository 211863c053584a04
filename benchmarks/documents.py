"""Results as JSON files."""

from __future__ import annotations

import dataclasses
import json
import types
import typing
from pathlib import Path
from typing import Any

from benchmarks.records import FORMAT, Document
from regnet_core.errors import InvalidInputError


def write_document(path: Path, document: Document) -> None:
    """Write a document; folders are made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps(_rounded(dataclasses.asdict(document)), indent=1)
    path.write_text(text + "\n", encoding="utf-8")


def read_document(path: Path) -> Document:
    """Read a document.

    Raises:
        InvalidInputError: there is no such file, or it holds something else.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InvalidInputError(f"'{path}' cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise InvalidInputError(f"'{path}' is no JSON: {error}") from error
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        found = data.get("format") if isinstance(data, dict) else None
        raise InvalidInputError(f"'{path}' holds no benchmark: its format is {found!r}, not {FORMAT!r}")
    return typing.cast(Document, _decoded(Document, data, path.name))


def _decoded(kind: Any, data: Any, where: str) -> Any:
    """A value of a type that is a dataclass, tuple[X, ...], dict[str, X], X | None, or plain."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if dataclasses.is_dataclass(kind):
        return _record(kind, data, where)
    if origin in (typing.Union, types.UnionType):
        chosen = next(argument for argument in arguments if argument is not type(None))
        return None if data is None else _decoded(chosen, data, where)
    if origin is tuple and isinstance(data, list):
        return tuple(_decoded(arguments[0], item, f"{where}[{i}]") for i, item in enumerate(data))
    if origin is dict and isinstance(data, dict):
        return {str(key): _decoded(arguments[1], value, f"{where}.{key}") for key, value in data.items()}
    if kind is float and isinstance(data, int | float) and not isinstance(data, bool):
        return float(data)
    if kind in (int, str, bool) and type(data) is kind:
        return data
    raise InvalidInputError(f"{where} must be {getattr(kind, '__name__', kind)}, got {data!r}")


def _record(kind: Any, data: Any, where: str) -> Any:
    if not isinstance(data, dict):
        raise InvalidInputError(f"{where} must be an object, got {data!r}")
    hints = typing.get_type_hints(kind)
    known = {item.name: item for item in dataclasses.fields(kind)}
    values = {}
    for name, item in known.items():
        if name in data:
            values[name] = _decoded(hints[name], data[name], f"{where}.{name}")
        elif item.default is dataclasses.MISSING and item.default_factory is dataclasses.MISSING:
            raise InvalidInputError(f"{where} has no '{name}'")
    unknown = sorted(set(data) - set(known))
    if unknown:
        raise InvalidInputError(f"{where} has '{unknown[0]}', which this version does not know")
    return kind(**values)


def _rounded(value: Any) -> Any:
    """Floats with six significant digits: more were not measured."""
    if isinstance(value, float):
        return float(f"{value:.6g}")
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    return [_rounded(item) for item in value] if isinstance(value, list | tuple) else value
