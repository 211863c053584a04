"""The networks by name, all from one configuration, and the rows of the paper's ablation table.

Parameters [M], and operations for one cloud counted as ledger.py says [GFLOP]:

| row  | what it has                                            | paper | ours  | paper  | ours  |
|------|--------------------------------------------------------|-------|-------|--------|-------|
| Sv1  | one head for confidence, class and residuals, 1 anchor | 5.545 | 5.545 |        | 149.6 |
| Sv2  | a second head, for class and residuals                 | 5.907 | 5.907 |        | 150.2 |
| Sv3  | a third head, for residuals; 4 anchors                 | 6.274 | 6.274 |        | 150.7 |
| Sv4  | grasp regions, which have no parameters                | 6.274 | 6.274 |        | 150.7 |
| Sv5  | the Refine Network                                     | 6.514 | 6.513 |        | 243.1 |
| Mv1  | as Sv1, and the width as a feature of every point      | 5.546 | 5.545 |        | 149.7 |
| Mv2  |                                                        | 5.909 | 5.908 |        | 150.3 |
| Mv3  |                                                        | 6.276 | 6.274 |        | 150.8 |
| Mv4  |                                                        | 6.276 | 6.274 | 151.03 | 150.8 |
| Mv5  |                                                        | 6.515 | 6.513 | 245.0  | 243.4 |

All rows have colours. What is in a row follows from the differences between the paper's numbers: a head
256-512-256-256-128 has 362,752 parameters, three more anchors 4,323, the Refine Network 239,702, and a width repeated
three times, as the published code has it, 1,152. With these and the backbone's 5,181,568 every row is met to the
last digit printed, but for Sv3 and Sv4, which would be rounded to 6.275 (test_ledger.py).

| name                   | parameters | GFLOP |                                       |
|------------------------|------------|-------|---------------------------------------|
| regnetv2               | 6.511      | 242.5 | the paper's size, without colours     |
| regnetv2-s             | 0.528      | 20.8  | 16384 points                          |
| regnet                 | 6.510      | 157.1 | 64 regions instead of 768             |
| regnet-s               | 0.528      | 5.3   | the same with the compact layers      |
| regnetv2-no-anchors    | 6.507      | 173.5 | a fourth of the proposals to refine   |
| regnetv2-no-region     | 6.511      | 242.5 |                                       |
| regnetv2-no-refinement | 6.273      | 150.5 |                                       |
"""

from __future__ import annotations

from dataclasses import replace

from regnet_core.errors import ModelError
from regnet_core.nn.anchors import CoderConfig
from regnet_core.nn.config import AbstractionConfig, NetworkConfig, RefinementConfig

WITHOUT_ANCHORS = CoderConfig(anchors=((1.0, 0.0, 0.0),))
"""A single direction that every closing direction is a residual of."""

REGNETV2 = NetworkConfig()
"""The paper's size."""

COMPACT_REFINEMENT = RefinementConfig(
    channels=(96, 96, 192), fusion=(192,), margin=0.01, point_features=True, passes=2, proposals=(768, 256)
)

REGNETV2_S = NetworkConfig(
    name="regnetv2-s",
    points=16384,
    least_confidence=0.02,
    shape_radius=0.012,
    abstractions=(
        AbstractionConfig(2048, 0.02, 32, (32, 32, 64)),
        AbstractionConfig(512, 0.06, 32, (64, 64, 128)),
        AbstractionConfig(128, 0.20, 32, (128, 128, 256)),
    ),
    propagations=((256, 256), (128, 128), (128, 128)),
    head=(128, 64),
    refinement=COMPACT_REFINEMENT,
)
"""Compact: what two cores of a CPU train, and run in real time."""

REGNET_V1 = REGNETV2.replace(name="regnet", width=False, positives=64)
"""The first version: for one width, and 64 regions."""

REGNET_V1_S = REGNETV2_S.replace(
    name="regnet-s", width=False, positives=64, refinement=replace(COMPACT_REFINEMENT, proposals=())
)
"""The first version with the compact layers."""

ABLATIONS = {
    "regnetv2-no-anchors": REGNETV2.replace(name="regnetv2-no-anchors", coder=WITHOUT_ANCHORS),
    "regnetv2-no-region": REGNETV2.replace(name="regnetv2-no-region", region=None),
    "regnetv2-no-refinement": REGNETV2.replace(name="regnetv2-no-refinement", refinement=None),
}

NETWORKS = {
    REGNETV2.name: REGNETV2,
    **{f"regnetv2-layer{n}": REGNETV2.replace(name=f"regnetv2-layer{n}", layer=n) for n in (2, 3)},
    REGNETV2_S.name: REGNETV2_S,
    **{f"regnetv2-s-layer{n}": REGNETV2_S.replace(name=f"regnetv2-s-layer{n}", layer=n, spacing=0.015) for n in (2, 3)},
    REGNET_V1.name: REGNET_V1,
    REGNET_V1_S.name: REGNET_V1_S,
    "regnetv2-s-no-width": REGNETV2_S.replace(name="regnetv2-s-no-width", width=False),
    **ABLATIONS,
}
"""Every network that has a name; ``replace(colour=True)`` gives the same with colours."""


def network_config(name: str) -> NetworkConfig:
    """The network of that name.

    Raises:
        ModelError: there is none.
    """
    if name not in NETWORKS:
        raise ModelError(f"no network '{name}'; there are {', '.join(NETWORKS)}")
    return NETWORKS[name]


def paper_row(row: str) -> NetworkConfig:
    """A row of the paper's ablation table, "Sv1" to "Sv5" and "Mv1" to "Mv5".

    Raises:
        ModelError: there is no such row.
    """
    rows = {f"{kind}v{n}": (kind == "M", n) for kind in "SM" for n in range(1, 6)}
    if row not in rows:
        raise ModelError(f"no row '{row}' in the paper's table; there are {', '.join(rows)}")
    width, version = rows[row]
    full = REGNETV2.replace(name=row, colour=True, width=width)
    return full.replace(
        grasp_heads=min(version - 1, 2),
        coder=full.coder if version >= 3 else WITHOUT_ANCHORS,
        region=full.region if version >= 4 else None,
        refinement=full.refinement if version >= 5 else None,
    )
