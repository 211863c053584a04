"""Which rows of a cloud stay: valid ones, those in the workspace, and some drawn at random. A pass or two each."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from numpy.lib.stride_tricks import as_strided

from regnet_core.geometry import Array
from regnet_core.ops.compiled import compiled, inlined
from regnet_core.ops.parallel import for_each_range

_HASH = np.uint64(0x9E3779B97F4A7C15)
"""2^64 over the golden ratio: its multiples are spread evenly."""
_FEW = 4
"""Less than one of so many is few."""
_NOT_MOVED = np.eye(4)
_UNIT = 2.0**-53
"""Makes a number in [0, 1) of 53 bits."""


def valid_rows(points: npt.NDArray[Any], largest: float) -> npt.NDArray[np.int64]:
    """Rows of the points (N, 3) whose three coordinates are numbers of at most this size, ascending."""
    rows = np.empty(len(points), np.int64)
    return rows[: _valid(points, largest, rows)]


class Usable(NamedTuple):
    """Which points of a cloud can be used."""

    rows: npt.NDArray[np.int64] | None
    """(K,), ascending; None: all of them."""
    valid: int
    """How many points are valid, wherever they lie."""
    number: int
    """K."""


def usable_points(points: npt.NDArray[Any], largest: float, lower: Array, upper: Array) -> Usable:
    """Points whose coordinates are numbers of at most a size, in a box.

    Args:
        points: (N, 3), in any layout [m].
        largest: coordinates beyond it are not valid [m].
        lower: (3,) corner of the box, which counts as inside; infinity has no limit [m].
        upper: (3,), likewise.
    """
    stays, counts = _marked(points, _NOT_MOVED, largest, lower, upper)
    valid, inside, starts = _shares(counts, len(points))
    if inside == len(points):
        return Usable(None, valid, inside)
    rows, blocks = np.empty(inside, np.int64), len(counts)
    for_each_range(_list, blocks, len(points) / blocks, stays, starts, rows)
    return Usable(rows, valid, inside)


class MovedRows(NamedTuple):
    """Points in another frame."""

    points: npt.NDArray[Any]
    """(K, 3) in the target frame [m]."""
    rows: npt.NDArray[np.int64] | None
    """(K,): the rows that they were in, ascending; None: nobody asked."""
    valid: int
    """How many points there were that are valid, wherever they lie."""
    inside: int
    """How many of those lie in the box."""


def moved_rows(
    points: npt.NDArray[Any],
    transform: Array,
    largest: float,
    lower: Array,
    upper: Array,
    most: int | None = None,
    seed: int = 0,
    dtype: type[np.floating] = np.float64,
    with_rows: bool = True,
) -> MovedRows:
    """Valid points in another frame, where they lie in a box there.

    Args:
        points: (N, 3) in the source frame, in any layout [m].
        transform: (4, 4), the pose of the source frame in the target frame.
        largest: as in ``valid_rows``.
        lower: (3,) corner of the box in the target frame [m]; infinity has no limit.
        upper: (3,), likewise.
        most: where there are more, so many are drawn, spread evenly over the rows (jittered sampling: one from each of
            as many runs of rows); None: all stay.
        seed: of the draw.
        dtype: of the result's points.
        with_rows: whether the rows are wanted.
    """
    stays, counts = _marked(points, transform, largest, lower, upper)
    valid, inside, starts = _shares(counts, len(points) if most is None else most)
    moved, rows = np.empty((starts[-1], 3), dtype), np.empty(starts[-1] if with_rows else 0, np.int64)
    (flat, step), blocks, key = _flat(points), len(counts), np.uint64(seed % 2**64)
    each = (len(points) + 6 * len(moved)) / blocks
    for_each_range(_put, blocks, each, flat, step, transform, stays, counts, starts, key, moved, rows)
    return MovedRows(moved, rows if with_rows else None, valid, inside)


def _marked(
    points: npt.NDArray[Any], transform: Array, largest: float, lower: Array, upper: Array
) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.int64]]:
    """Which of the points (N, 3) are valid and in the box, and how many of each block are valid, and both."""
    blocks = blocks_of_rows(len(points))
    counts, stays = np.empty((blocks, 2), np.int64), np.empty(len(points), np.uint8)
    flat, step = _flat(points)
    for_each_range(_mark, blocks, len(points) / blocks, flat, step, transform, largest, lower, upper, counts, stays)
    return stays, counts


def _flat(points: npt.NDArray[Any]) -> tuple[npt.NDArray[Any], int]:
    """The numbers of points (N, 3) in memory, what lies between points included, and from one point to the next."""
    if points.flags.c_contiguous:
        return points.reshape(-1), 3
    size, (across, along) = points.itemsize, points.strides
    if len(points) > 0 and along == size and across >= 3 * size and across % size == 0 and points.flags.aligned:
        step = across // size
        return as_strided(points, ((len(points) - 1) * step + 3,), (size,), writeable=False), step
    return np.ascontiguousarray(points).reshape(-1), 3


def blocks_of_rows(count: int) -> int:
    """How many blocks of about a thousand; it does not depend on the machine, as what is drawn depends on it."""
    return min(max(count // 1024, 1), 64)


def rows_in_box(points: npt.NDArray[Any], lower: npt.NDArray[Any], upper: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
    """Rows of the points (N, 3) in a box, its surface included, ascending.

    Args:
        points: (N, 3).
        lower: (3,) corner of the box.
        upper: (3,), likewise.
    """
    rows = np.empty(len(points), np.int64)
    return rows[: _inside(points, lower, upper, rows)]


def chosen_rows(count: int, size: int, rng: np.random.Generator) -> npt.NDArray[np.int64]:
    """``size`` of ``count`` rows, ascending, each set of them as likely as any other; ``size`` is at most ``count``.

    Few are drawn one by one, again where one is there already. Otherwise each row is taken with the chance of what is
    still wanted among what is still to come (selection sampling, Knuth, "The Art of Computer Programming", vol. 2,
    algorithm S), in blocks whose shares are drawn before.
    """
    rows = np.empty(size + 1, np.int64)
    if size * _FEW < count:
        _choose_few(count, size, rng.integers(2**64, dtype=np.uint64), rows)
        return rows[:size]
    blocks = blocks_of_rows(count)
    limits = count * np.arange(blocks + 1) // blocks
    wanted, key = rng.multivariate_hypergeometric(np.diff(limits), size), rng.integers(2**64, dtype=np.uint64)
    for_each_range(_choose, blocks, 1.5 * count / blocks, limits, wanted, np.cumsum(wanted) - wanted, key, rows)
    return rows[:size]


def spread_rows(count: int, size: int, rng: np.random.Generator) -> npt.NDArray[np.int64]:
    """``size`` of ``count`` rows, ascending: one from each of as many runs of rows (jittered sampling)."""
    return _spread(count, size, rng.integers(2**64, dtype=np.uint64))  # type: ignore[no-any-return]


def taken(
    points: npt.NDArray[Any], rows: npt.NDArray[np.int64], dtype: type[np.floating] = np.float64
) -> npt.NDArray[Any]:
    """(K, 3): rows (K,) of points (N, 3), of that type; several times faster than indexing."""
    result = np.empty((len(rows), 3), dtype)
    for_each_range(_take, len(rows), 2, points, rows, result)
    return result


@compiled
def _take(begin, end, points, rows, result):  # type: ignore[no-untyped-def]
    for i in range(begin, end):
        row = rows[i]
        result[i, 0], result[i, 1], result[i, 2] = points[row, 0], points[row, 1], points[row, 2]


@inlined
def _random(key, number):  # type: ignore[no-untyped-def]
    """A number in [0, 1) that belongs to a whole one (Steele, Lea, Flood, "Fast splittable pseudorandom number
    generators", 2014)."""
    mixed = key + np.uint64(number + 1) * _HASH
    mixed = (mixed ^ (mixed >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    mixed = mixed ^ (mixed >> np.uint64(31))
    return np.float64(mixed >> np.uint64(11)) * _UNIT


@inlined
def _drawn(key, number, left, still):  # type: ignore[no-untyped-def]
    """Whether one of ``left`` is among those of which ``still`` are wanted, by a random number of its own."""
    return _random(key, number) * left < still


@compiled
def _spread(count, size, key):  # type: ignore[no-untyped-def]
    rows = np.empty(size, np.int64)
    for i in range(size):
        first, after = count * i // size, count * (i + 1) // size
        rows[i] = first + min(int(_random(key, i) * (after - first)), after - first - 1)
    return rows


@compiled
def _choose_few(count, size, key, rows):  # type: ignore[no-untyped-def]
    there, number, still = np.zeros(count, np.uint8), 0, size
    while still > 0:
        place = int(_random(key, number) * count)
        number += 1
        still -= 1 - there[place]
        there[place] = 1
    n = 0
    for p in range(count):
        # Without a branch: written over by the next one where it is not there.
        rows[n] = p
        n += there[p]


@compiled
def _choose(begin, end, limits, wanted, starts, key, rows):  # type: ignore[no-untyped-def]
    for block in range(begin, end):
        n, stop = starts[block], starts[block] + wanted[block]
        for p in range(limits[block], limits[block + 1]):
            if n == stop:
                break
            rows[n] = p
            n += _drawn(key, p, limits[block + 1] - p, stop - n)


@compiled
def _valid(points, largest, rows):  # type: ignore[no-untyped-def]
    n = 0
    for p in range(len(points)):
        # False for NaN.
        if abs(points[p, 0]) <= largest and abs(points[p, 1]) <= largest and abs(points[p, 2]) <= largest:
            rows[n] = p
            n += 1
    return n


@compiled
def _inside(points, lower, upper, rows):  # type: ignore[no-untyped-def]
    n = 0
    for p in range(len(points)):
        # Without a branch: written over by the next one where it is outside.
        rows[n] = p
        n += (
            (lower[0] <= points[p, 0] <= upper[0])
            & (lower[1] <= points[p, 1] <= upper[1])
            & (lower[2] <= points[p, 2] <= upper[2])
        )
    return n


@inlined
def _place(transform, a, b, c):  # type: ignore[no-untyped-def]
    x = transform[0, 0] * a + transform[0, 1] * b + transform[0, 2] * c + transform[0, 3]
    y = transform[1, 0] * a + transform[1, 1] * b + transform[1, 2] * c + transform[1, 3]
    z = transform[2, 0] * a + transform[2, 1] * b + transform[2, 2] * c + transform[2, 3]
    return x, y, z


@inlined
def within_box(lower, upper, x, y, z):  # type: ignore[no-untyped-def]
    """Whether a point is in a box, its surface included; without a branch, and false for NaN."""
    return (
        (lower[0] <= x) & (x <= upper[0]) & (lower[1] <= y) & (y <= upper[1]) & (lower[2] <= z) & (z <= upper[2])
    )  # fmt: skip


@compiled
def _mark(begin, end, flat, step, transform, largest, lower, upper, counts, stays):  # type: ignore[no-untyped-def]
    """Of blocks of points: how many are valid, how many of those are in the box, and which."""
    limited = False
    for a in range(3):
        limited |= lower[a] != -np.inf or upper[a] != np.inf
    for block in range(begin, end):
        first, last = len(stays) * block // len(counts), len(stays) * (block + 1) // len(counts)
        given, own = flat[step * first :], stays[first:last]
        # Where it is known that nothing lies between points, many of them are looked at at a time.
        valid = _mark_valid(given, 3, largest, own) if step == 3 else _mark_valid(given, step, largest, own)
        inside = valid
        if limited:
            inside = 0
            for p in range(len(own)):
                x, y, z = _place(transform, given[step * p], given[step * p + 1], given[step * p + 2])
                own[p] &= within_box(lower, upper, x, y, z)
                inside += own[p]
        counts[block, 0], counts[block, 1] = valid, inside


@compiled
def _shares(counts, most):  # type: ignore[no-untyped-def]
    """How many points there are, how many of those are in the box, and where those of each block begin among the ones
    that stay, of which there are at most so many -> (blocks + 1,)."""
    starts, valid, inside = np.zeros(len(counts) + 1, np.int64), 0, 0
    for block in range(len(counts)):
        valid += counts[block, 0]
        inside += counts[block, 1]
        starts[block + 1] = inside
    if most < inside:
        for block in range(len(starts)):
            starts[block] = starts[block] * most // inside
    return valid, inside, starts


@inlined
def _mark_valid(given, step, largest, stays):  # type: ignore[no-untyped-def]
    valid = 0
    for p in range(len(stays)):
        x, y, z = given[step * p], given[step * p + 1], given[step * p + 2]
        good = (abs(x) <= largest) & (abs(y) <= largest) & (abs(z) <= largest)  # false for NaN
        stays[p] = good
        valid += good
    return valid


@compiled
def _list(begin, end, stays, starts, rows):  # type: ignore[no-untyped-def]
    blocks = len(starts) - 1
    for block in range(begin, end):
        n = starts[block]
        for p in range(len(stays) * block // blocks, len(stays) * (block + 1) // blocks):
            if n == starts[block + 1]:
                break
            # Without a branch that nobody could foresee: written over by the next one where it goes.
            rows[n] = p
            n += stays[p]


@compiled
def _put(begin, end, flat, step, transform, stays, counts, starts, key, moved, rows):  # type: ignore[no-untyped-def]
    there = np.empty(len(stays) // len(counts) + 2, np.int64)
    for block in range(begin, end):
        first, last = len(stays) * block // len(counts), len(stays) * (block + 1) // len(counts)
        start, wanted, n = starts[block], starts[block + 1] - starts[block], 0
        for p in range(first, last):
            # Without a branch that nobody could foresee: written over by the next one where it goes.
            there[n] = p
            n += stays[p]
        chosen = there[:n]
        if wanted < n:
            chosen = _drawn_evenly(chosen, wanted, key + np.uint64(first))
        for i in range(wanted):
            p = chosen[i]
            x, y, z = _place(transform, flat[step * p], flat[step * p + 1], flat[step * p + 2])
            moved[start + i, 0], moved[start + i, 1], moved[start + i, 2] = x, y, z
        for i in range(wanted if len(rows) > 0 else 0):
            rows[start + i] = chosen[i]


@compiled
def _drawn_evenly(given, wanted, key):  # type: ignore[no-untyped-def]
    """``wanted`` of the given numbers, the first of the result: one from each of as many runs of those that stay, or of
    those that go where they are fewer."""
    count = len(given)
    goes = 2 * wanted > count
    marked = count - wanted if goes else wanted
    each, before = count / max(marked, 1), -1
    places = np.empty(marked, np.int32)
    for i in range(marked):
        places[i] = min(int((i + _random(key, i)) * each), count - 1)
    for i in range(marked):
        before = max(places[i], before + 1)
        places[i] = before
    if not goes:
        return given[places]
    stays, n = np.ones(count, np.uint8), 0
    for i in range(marked):
        stays[places[i]] = 0
    chosen = np.empty(count, given.dtype)
    for i in range(count):
        # Without a branch that nobody could foresee: written over by the next one where it goes.
        chosen[n] = given[i]
        n += stays[i]
    return chosen
