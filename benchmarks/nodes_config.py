"""The parameters with which users start the nodes: config/regnet.yaml."""

from __future__ import annotations

from typing import Any

import yaml

from benchmarks.errors import BenchmarkError
from benchmarks.machine import ROOT

CONFIG = ROOT / "config" / "regnet.yaml"


def node_parameters(node: str) -> dict[str, Any]:
    """Those of one node.

    Raises:
        BenchmarkError: the file does not name the node.
    """
    document = yaml.safe_load(CONFIG.read_text(encoding="utf-8"))
    try:
        return dict(document[f"/**/{node}"]["ros__parameters"])
    except (KeyError, TypeError) as error:
        raise BenchmarkError(f"{CONFIG.name} has no parameters of '{node}' any more") from error
