"""Writes the tables of the nodes' parameters into README.md and docs/, between the markers that name each node.

python tools/parameter_tables.py [--check]
"""

import argparse
import dataclasses
import os
import sys
from pathlib import Path

from regnet_core.weights import OWN_FOLDER
from regnet_ros.parameters import NodeParameters, rules
from regnet_ros.settings import DetectorParameters, ExecutorParameters, PreprocessorParameters, SelectorParameters

ROOT = Path(__file__).resolve().parent.parent
TABLES: dict[str, dict[str, type[NodeParameters]]] = {
    "README.md": {
        "preprocessor": PreprocessorParameters,
        "detector": DetectorParameters,
        "selector": SelectorParameters,
    },
    "docs/executor.md": {"executor": ExecutorParameters},
}
"""File: the nodes whose tables it has."""


def main() -> int:
    """Update the files, or with --check only say whether they are up to date."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="change nothing; exit with 1 if something is outdated")
    check = parser.parse_args().check
    os.environ.pop(OWN_FOLDER, None)  # networks of one's own do not belong into the tables
    outdated = 0
    for name, tables in TABLES.items():
        old = (ROOT / name).read_text(encoding="utf-8")
        new = with_tables(old, name, tables)
        outdated |= old != new
        if not check:
            (ROOT / name).write_text(new, encoding="utf-8")
    return int(check and outdated)


def with_tables(text: str, name: str, tables: dict[str, type[NodeParameters]]) -> str:
    """A file's text with every table as the code has it."""
    for node, table in tables.items():
        begin, end = f"<!-- parameters of {node} -->", f"<!-- end of {node} -->"
        if begin not in text or end not in text:
            raise SystemExit(f"{name} lacks the markers '{begin}' and '{end}'")
        head, rest = text.split(begin, 1)
        text = f"{head}{begin}\n{markdown(table)}\n{end}{rest.split(end, 1)[1]}"
    return text


def markdown(table: type[NodeParameters]) -> str:
    """One row for each parameter: name, default, accepted values, description."""
    rows = ["| parameter | default | accepted | meaning |", "|---|---|---|---|"]
    defaults = {field.name: field.default for field in dataclasses.fields(table)}
    for name, rule in rules(table).items():
        accepted = rule.constraints + (" (fixed at start)" if rule.read_only else "")
        rows.append(f"| `{name}` | {_default(defaults[name])} | {accepted.strip()} | {rule.description} |")
    return "\n".join(rows)


def _default(value: object) -> str:
    if isinstance(value, tuple):
        return f"`[{', '.join(f'{v:g}' for v in value)}]`"
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    return f"`{value:g}`" if isinstance(value, float) else f"`{value!r}`" if value == "" else f"`{value}`"


if __name__ == "__main__":
    sys.exit(main())
