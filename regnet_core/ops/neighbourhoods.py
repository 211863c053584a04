"""Ragged neighbourhoods: which points belong to each of C centres, without padding (CSR)."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch

from regnet_core.ops.compiled import compiled, inlined
from regnet_core.ops.parallel import for_each_range


class Neighbourhoods(NamedTuple):
    """The neighbours of C centres; those of centre c are ``indices[offsets[c]:offsets[c + 1]]``, in any order."""

    indices: torch.Tensor
    """(E,) int64: rows of the points."""
    offsets: torch.Tensor
    """(C + 1,) int64, from 0 to E."""

    @property
    def counts(self) -> torch.Tensor:
        """(C,): how many neighbours each centre has."""
        return self.offsets.diff()

    def centres(self) -> torch.Tensor:
        """(E,): the centre that each neighbour belongs to."""
        index = torch.arange(len(self.offsets) - 1, device=self.offsets.device)
        return torch.repeat_interleave(index, self.counts, output_size=len(self.indices))

    def tiles(self, rows: int) -> Iterator[tuple[slice, Neighbourhoods]]:
        """Runs of centres with at most so many neighbours together (a single centre may have more), and these."""
        bounds, first = self.offsets.tolist(), 0
        while first < len(bounds) - 1:
            last = max(bisect_right(bounds, bounds[first] + rows) - 1, first + 1)
            own = slice(bounds[first], bounds[last])
            yield slice(first, last), Neighbourhoods(self.indices[own], self.offsets[first : last + 1] - own.start)
            first = last

    def to(self, device: torch.device | str) -> Neighbourhoods:
        """The same on another device."""
        return Neighbourhoods(self.indices.to(device), self.offsets.to(device))


def offsets_from_centres(
    points: torch.Tensor, centres: torch.Tensor, near: Neighbourhoods, unit: float
) -> torch.Tensor:
    """Where E neighbours are as seen from their centres -> (E, 3) float32, in that unit; no gradients.

    Args:
        points: (N, 3) float32 [m].
        centres: (C, 3) float32 [m].
        near: of the centres, as rows of the points.
        unit: [m].
    """
    points, centres = points.detach(), centres.detach()
    if points.device.type != "cpu":
        return (points.index_select(0, near.indices) - centres.index_select(0, near.centres())) / unit
    offsets = torch.empty((len(near.indices), 3))
    where, middle, out = points.contiguous().numpy(), centres.contiguous().numpy(), offsets.numpy()
    rows, bounds = near.indices.numpy(), near.offsets.numpy()

    each = 3 * len(rows) / max(len(middle), 1)
    for_each_range(_look, len(middle), each, where, middle, np.float32(unit), rows, bounds, out)
    return offsets


def joined(parts: Sequence[Neighbourhoods], first_points: Sequence[int]) -> Neighbourhoods:
    """The neighbourhoods of several clouds as those of their concatenation.

    Args:
        parts: of each cloud, with the cloud's own point numbers.
        first_points: where each cloud's points begin in the concatenation.
    """
    if len(parts) == 1 and first_points[0] == 0:
        return parts[0]
    indices = torch.cat([part.indices + first for part, first in zip(parts, first_points, strict=True)])
    counts = torch.cat([part.counts for part in parts])
    offsets = torch.zeros(len(counts) + 1, dtype=torch.int64, device=counts.device)
    torch.cumsum(counts, 0, out=offsets[1:])
    return Neighbourhoods(indices, offsets)


def collect(search: Callable[..., None], count: int, most: int, each: float, *arguments: object) -> Neighbourhoods:
    """Run a compiled search over all centres and close the gaps that it leaves.

    Args:
        search: ``search(begin, end, *arguments, counts, found)`` fills ``found`` (C, most), int32, and ``counts`` (C,)
            for a range of centres.
        count: C.
        most: K, the most neighbours of a centre.
        each: about how long the search takes for a centre [ns].
        arguments: what the search is given.
    """
    found = np.empty((count, most), np.int32)
    counts = np.zeros(count, np.int64)
    for_each_range(search, count, each, *arguments, counts, found)
    offsets = np.zeros(count + 1, np.int64)
    np.cumsum(counts, out=offsets[1:])
    indices = np.empty(offsets[-1], np.int64)
    for_each_range(_compact, count, most, found, offsets, indices)
    return Neighbourhoods(torch.from_numpy(indices), torch.from_numpy(offsets))


def from_mask(inside: torch.Tensor, most: int) -> Neighbourhoods:
    """The first ``most`` points of each centre, given which points belong to it (C, N); for any device."""
    kept = inside & (inside.cumsum(dim=1, dtype=torch.int32) <= most)
    offsets = torch.zeros(len(inside) + 1, dtype=torch.int64, device=inside.device)
    torch.cumsum(kept.sum(dim=1), 0, out=offsets[1:])
    return Neighbourhoods(kept.nonzero()[:, 1], offsets)


@inlined
def keep_first(near, n, centre, counts, found):  # type: ignore[no-untyped-def]
    """Write the smallest of ``near[:n]`` (in any order, which changes) to the centre's row of ``found``."""
    most = found.shape[1]
    kept = min(n, most)
    low, high = 0, n - 1 if n > most else 0
    while low < high:  # quickselect: afterwards the smallest come first
        pivot = near[(low + high) >> 1]
        a, b = low, high
        while a <= b:
            while near[a] < pivot:
                a += 1
            while near[b] > pivot:
                b -= 1
            if a <= b:
                near[a], near[b] = near[b], near[a]
                a += 1
                b -= 1
        if most - 1 <= b:
            high = b
        elif most - 1 >= a:
            low = a
        else:
            break
    for e in range(kept):
        found[centre, e] = near[e]
    counts[centre] = kept


@compiled
def _compact(begin, end, found, offsets, indices):  # type: ignore[no-untyped-def]
    for c in range(begin, end):
        for i in range(offsets[c + 1] - offsets[c]):
            indices[offsets[c] + i] = found[c, i]


@compiled
def _look(begin, end, points, centres, unit, indices, offsets, out):  # type: ignore[no-untyped-def]
    for c in range(begin, end):
        x, y, z = centres[c, 0], centres[c, 1], centres[c, 2]
        for e in range(offsets[c], offsets[c + 1]):
            row = indices[e]
            out[e, 0], out[e, 1], out[e, 2] = (
                (points[row, 0] - x) / unit, (points[row, 1] - y) / unit, (points[row, 2] - z) / unit
            )  # fmt: skip


def newly_marked(marked: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
    """Those of the rows (n,), in any order and as often as they like, that were not marked in (N,) bool -> (k,) int64,
    ascending; they are marked then. On a CPU."""
    new = np.empty(len(marked) + 1, np.int64)
    return torch.from_numpy(new[: _mark(marked.numpy(), rows.numpy(), np.zeros(len(marked), np.bool_), new)])


@compiled
def _mark(marked, rows, wanted, new):  # type: ignore[no-untyped-def]
    for i in range(len(rows)):
        wanted[rows[i]] = True
    n = 0
    for row in range(len(marked)):
        new[n] = row
        n += wanted[row] and not marked[row]
        marked[row] |= wanted[row]
    return n
