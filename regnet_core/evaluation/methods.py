"""The methods of the paper's main table, as far as there are weights."""

from __future__ import annotations

from regnet_core.models import available_models

ALL = "all"
"""Stands for ``main_table``."""
MAIN_TABLE = (
    "random",
    "antipodal",
    "gpd-3",
    "gpd-12",
    "pointnetgpd",
    "s4g",
    "regnet",
    "regnet-s",
    "regnetv2",
    "regnetv2-s",
)
"""In the paper's order; of our two sizes the larger first."""


def main_table() -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Those that can run, and those that have no weights."""
    there = set(available_models())
    ready = tuple(name for name in MAIN_TABLE if name in there)
    return ready, tuple(name for name in MAIN_TABLE if name not in there)
