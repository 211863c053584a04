"""Features of the clouds' points, computed for those that are asked about.

In a detection only points on objects may become positive, and only points near objects lie between fingers: of a table
top, most points need no features of their own. The centroids that they gave theirs to have heard of them.
"""

from __future__ import annotations

from collections.abc import Callable

import torch

from regnet_core.nn.backbone import Backbone, Coarse
from regnet_core.ops.arrays import put_rows
from regnet_core.ops.neighbourhoods import newly_marked

Carry = Callable[[torch.Tensor], torch.Tensor | None]
"""What the Refine Network makes of features (n, C) in its first layer -> (n, C_1); None where it does not take them."""


class PointFeatures:
    """What the last feature propagation and the Refine Network's first layer give, for some points or for all."""

    values: torch.Tensor
    """(N, C); anything for points that were not needed yet."""
    carried: torch.Tensor | None
    """(N, C_1), likewise; None where the Refine Network does not take features."""

    def __init__(self, backbone: Backbone, carry: Carry, coarse: Coarse, of_all: bool) -> None:
        """Args:
        backbone: of the network.
        carry: of the Refine Network.
        coarse: what ``backbone.coarse`` gives.
        of_all: compute them for all points now, not later for those that are needed.
        """
        self._backbone, self._carry, self._coarse = backbone, carry, coarse
        self._there: torch.Tensor | None = None
        if of_all:
            self.values = backbone.fine(coarse, None)
            self.carried = carry(self.values)
        else:
            points = coarse.clouds.points
            self._there = torch.zeros(len(points), dtype=torch.bool, device=points.device)
            self.values, self.carried = points.new_empty((len(points), backbone.config.features)), None

    def need(self, rows: torch.Tensor) -> None:
        """Compute them for these points (n,), in any order, where they are not there."""
        if self._there is None:
            return
        missing = newly_marked(self._there, rows)
        if len(missing) == 0:
            return
        found = self._backbone.fine(self._coarse, missing)
        self.values = _put(self.values, missing, found)
        if (carried := self._carry(found)) is not None:
            room = carried.new_empty((len(self.values), carried.shape[1])) if self.carried is None else self.carried
            self.carried = _put(room, missing, carried)


def _put(room: torch.Tensor, rows: torch.Tensor, found: torch.Tensor) -> torch.Tensor:
    """Rows (n,) of ``room`` filled; its type becomes that of what is found."""
    room = room.to(found.dtype)
    put_rows(room, rows, found)
    return room
