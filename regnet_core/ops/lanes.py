"""Questions asked of 32 points or of 16 boxes at a time, with a bit of the answer for each; and sums of 16 numbers.

numba has no vectors, but lets functions be written as LLVM's intermediate code, which has them for every processor;
they become part of the loops that call them. Numbers are float32, and are rounded as one by one: nothing is fused.

Points lie in memory as (3, 32) float32, their x, then y, then z; boxes as (6, 16), the x, y and z of their lower
corners, then those of the upper ones. Arguments are addresses of these, and float32 numbers [m]; results are int64.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

POINTS, BOXES = 32, 16
"""How many there are."""

_written: Callable[[Callable[..., Any]], Any] = intrinsic
"""To mypy, what comes of it is as untyped as compiled functions are."""
_INT32, _INT64, _FLOAT = ir.IntType(32), ir.IntType(64), ir.FloatType()


class _Lanes:
    """Writes code for so many numbers at a time."""

    def __init__(self, builder: Any, count: int) -> None:
        self.build, self.count = builder, count
        self.floats = ir.VectorType(_FLOAT, count)

    def row(self, address: Any, number: int) -> Any:
        """A row of an array in memory."""
        place = self.build.add(address, _INT64(4 * self.count * number))
        return self.build.load(self.build.inttoptr(place, self.floats.as_pointer()), align=4)

    def all(self, value: Any) -> Any:
        """The same number everywhere."""
        nothing = ir.Constant(self.floats, ir.Undefined)
        one = self.build.insert_element(nothing, value, _INT32(0))
        order = ir.Constant(ir.VectorType(_INT32, self.count), [0] * self.count)
        return self.build.shuffle_vector(one, nothing, order)

    def larger(self, one: Any, other: Any) -> Any:
        return self.build.select(self.build.fcmp_ordered(">", one, other), one, other)

    def size(self, value: Any) -> Any:
        """Without the sign."""
        zero = ir.Constant(self.floats, [0.0] * self.count)
        return self.build.select(self.build.fcmp_ordered("<", value, zero), self.build.fneg(value), value)

    def dot(self, one: list[Any], other: list[Any]) -> Any:
        """The sum of three products, from the first to the last."""
        products = [self.build.fmul(a, b) for a, b in zip(one, other, strict=True)]
        return self.build.fadd(self.build.fadd(products[0], products[1]), products[2])

    def largest(self, value: Any) -> Any:
        """The largest of all, none of which is below 0: the bits of such numbers are in the order of the numbers."""
        kind = ir.VectorType(_INT32, self.count)
        name, module = f"llvm.vector.reduce.smax.v{self.count}i32", self.build.module
        largest = module.globals.get(name) or ir.Function(module, ir.FunctionType(_INT32, [kind]), name)
        return self.build.bitcast(self.build.call(largest, [self.build.bitcast(value, kind)]), _FLOAT)

    def bits(self, truth: Any) -> Any:
        """A bit for each, the first one lowest, as int64."""
        whole = self.build.bitcast(truth, ir.IntType(self.count))
        return self.build.zext(whole, _INT64)


def _asking(count: int, numbers: int, code: Callable[..., Any], addresses: int = 1, result: Any = types.int64) -> Any:
    """The signature and the generator of an intrinsic with code that is given addresses and float32 numbers."""
    signature = result(*(types.int64,) * addresses, *(types.float32,) * numbers)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        lanes = _Lanes(builder, count)
        return code(lanes, *arguments[:addresses], [lanes.all(number) for number in arguments[addresses:]])

    return signature, generate


def _in_ball(lanes: _Lanes, address: Any, given: list[Any]) -> Any:
    offsets = [lanes.build.fsub(lanes.row(address, a), given[a]) for a in range(3)]
    return lanes.bits(lanes.build.fcmp_ordered("<=", lanes.dot(offsets, offsets), given[3]))


def _in_ball_apart(lanes: _Lanes, address: Any, apart: Any, given: list[Any]) -> Any:
    rows, build = [address], lanes.build
    for _ in range(2):
        rows.append(build.add(rows[-1], apart))
    offsets = [build.fsub(lanes.row(row, 0), given[a]) for a, row in enumerate(rows)]
    return lanes.bits(build.fcmp_ordered("<=", lanes.dot(offsets, offsets), given[3]))


def _in_hand(lanes: _Lanes, address: Any, apart: Any, given: list[Any]) -> Any:
    build, rows = lanes.build, [address]
    for _ in range(2):
        rows.append(build.add(rows[-1], apart))
    offsets = [build.fsub(lanes.row(row, 0), given[9 + a]) for a, row in enumerate(rows)]
    x, y, z = (lanes.dot([given[3 * row + axis] for row in range(3)], offsets) for axis in range(3))
    y = lanes.size(y)
    half, back, front, face, palm, inner, outer = given[12:]

    def holds(one: Any, sign: str, other: Any) -> Any:
        return build.fcmp_ordered(sign, one, other)

    there = build.and_(holds(lanes.size(z), "<=", half), build.and_(holds(x, ">=", back), holds(x, "<=", front)))
    behind = holds(x, "<=", face)
    in_palm = build.and_(behind, holds(y, "<=", palm))
    in_fingers = build.and_(build.not_(behind), build.and_(holds(y, ">=", inner), holds(y, "<=", outer)))
    palm_bits, finger_bits = (lanes.bits(build.and_(there, part)) for part in (in_palm, in_fingers))
    return build.or_(palm_bits, build.shl(finger_bits, _INT64(BOXES)))


def _gaps(lanes: _Lanes, given: list[Any], lower: list[Any], upper: list[Any]) -> Any:
    """Squared distances between boxes or points and a box."""
    zero, gaps = ir.Constant(lanes.floats, [0.0] * lanes.count), []
    for a in range(3):
        before, behind = lanes.build.fsub(lower[a], given[3 + a]), lanes.build.fsub(given[a], upper[a])
        gaps.append(lanes.larger(lanes.larger(before, behind), zero))
    return lanes.dot(gaps, gaps)


def _near_box(lanes: _Lanes, address: Any, given: list[Any]) -> Any:
    at = [lanes.row(address, a) for a in range(3)]
    return lanes.bits(lanes.build.fcmp_ordered("<=", _gaps(lanes, given, at, at), given[6]))


def _boxes_near_box(lanes: _Lanes, address: Any, given: list[Any]) -> Any:
    corners = [lanes.row(address, a) for a in range(6)]
    return lanes.bits(lanes.build.fcmp_ordered("<=", _gaps(lanes, given, corners[:3], corners[3:]), given[6]))


def _in_turned_box(lanes: _Lanes, address: Any, given: list[Any]) -> Any:
    build, inside = lanes.build, None
    offsets = [build.fsub(lanes.row(address, a), given[9 + a]) for a in range(3)]
    for a in range(3):
        along = lanes.size(lanes.dot(given[3 * a : 3 * a + 3], offsets))
        near = build.fcmp_ordered("<", along, given[12 + a])
        inside = near if inside is None else build.and_(inside, near)
    return lanes.bits(inside)


def _boxes_at_turned_box(lanes: _Lanes, address: Any, given: list[Any]) -> Any:
    build, meets = lanes.build, None
    half = ir.Constant(lanes.floats, [0.5] * lanes.count)
    offsets, extents = [], []
    for a in range(3):
        lower, upper = lanes.row(address, a), lanes.row(address, 3 + a)
        centre = build.fmul(build.fadd(lower, upper), half)
        offsets.append(build.fsub(centre, given[9 + a]))
        extents.append(build.fsub(upper, centre))
    for a in range(3):
        axis = given[3 * a : 3 * a + 3]
        reach = build.fadd(lanes.dot([lanes.size(part) for part in axis], extents), given[12 + a])
        near = build.fcmp_ordered("<=", lanes.size(lanes.dot(axis, offsets)), reach)
        meets = near if meets is None else build.and_(meets, near)
    return lanes.bits(meets)


def _boxes_within(lanes: _Lanes, address: Any, limits: Any, given: list[Any]) -> Any:
    corners = [lanes.row(address, a) for a in range(6)]
    gaps = _gaps(lanes, [*given, *given], corners[:3], corners[3:])
    return lanes.bits(lanes.build.fcmp_ordered("<", gaps, lanes.row(limits, 0)))


def _draw(lanes: _Lanes, address: Any, known: Any, given: list[Any]) -> Any:
    offsets = [lanes.build.fsub(lanes.row(address, a), given[a]) for a in range(3)]
    squared, before = lanes.dot(offsets, offsets), lanes.row(known, 0)
    nearer = lanes.build.select(lanes.build.fcmp_ordered("<", squared, before), squared, before)
    lanes.build.store(nearer, lanes.build.inttoptr(known, lanes.floats.as_pointer()), align=4)
    return lanes.largest(nearer)


def _largest(lanes: _Lanes, address: Any, given: list[Any]) -> Any:
    return lanes.largest(lanes.row(address, 0))


def _equal(lanes: _Lanes, address: Any, given: list[Any]) -> Any:
    return lanes.bits(lanes.build.fcmp_ordered("==", lanes.row(address, 0), given[0]))


@_written
def in_ball(context, points, x, y, z, squared):  # type: ignore[no-untyped-def]
    """Which points are within a distance, of which the square is given, of x, y, z."""
    return _asking(POINTS, 4, _in_ball)


@_written
def in_ball_apart(context, points, apart, x, y, z, squared):  # type: ignore[no-untyped-def]
    """Which of 16 points are within a distance, of which the square is given, of x, y, z; their y are so many bytes
    behind their x, and their z as many behind their y."""
    return _asking(BOXES, 4, _in_ball_apart, addresses=2)


@_written
def in_hand(context, points, apart, a, b, c, d, e, f, g, h, i, x, y, z, half, back, front, face, palm, inner, outer):  # type: ignore[no-untyped-def]
    """Which of 16 points, stored as for ``in_ball_apart``, are in a palm, and, in the next 16 bits, which in fingers.

    ``a`` to ``i`` are the rows of the hand's rotation, one after the other; x, y, z is its centre. In its frame points
    count with |z| of at most ``half`` and x from ``back`` to ``front``. Up to ``face`` it is the palm, with |y| of at
    most ``palm``; from there on fingers, with |y| from ``inner`` to ``outer``.
    """
    return _asking(BOXES, 19, _in_hand, addresses=2)


@_written
def number_of_bits(context, bits):  # type: ignore[no-untyped-def]
    """How many bits (int64) are set."""

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        return builder.ctpop(arguments[0])

    return types.int64(types.int64), generate


@_written
def near_box(context, points, x0, y0, z0, x1, y1, z1, squared):  # type: ignore[no-untyped-def]
    """Which points are within a distance, of which the square is given, of the box between two corners."""
    return _asking(POINTS, 7, _near_box)


@_written
def boxes_near_box(context, boxes, x0, y0, z0, x1, y1, z1, squared):  # type: ignore[no-untyped-def]
    """Which boxes are within a distance, of which the square is given, of the box between two corners."""
    return _asking(BOXES, 7, _boxes_near_box)


@_written
def in_turned_box(context, points, a0, a1, a2, b0, b1, b2, c0, c1, c2, x, y, z, u, v, w):  # type: ignore[no-untyped-def]
    """Which points are inside the box with the unit axes a, b, c, its middle at x, y, z, and half sides u, v, w."""
    return _asking(POINTS, 15, _in_turned_box)


@_written
def boxes_at_turned_box(context, boxes, a0, a1, a2, b0, b1, b2, c0, c1, c2, x, y, z, u, v, w):  # type: ignore[no-untyped-def]
    """Which boxes no side of the box with the axes a, b, c, its middle at x, y, z, and half sides u, v, w keeps off it:
    all that meet it, and some that do not."""
    return _asking(BOXES, 15, _boxes_at_turned_box)


@_written
def boxes_within(context, boxes, limits, x, y, z):  # type: ignore[no-untyped-def]
    """Which boxes are nearer to x, y, z than each one's limit says: (16,) squared distances at the second address."""
    return _asking(BOXES, 3, _boxes_within, addresses=2)


@_written
def draw(context, points, known, x, y, z):  # type: ignore[no-untyped-def]
    """Make the squared distances (32,) at the second address those to x, y, z where these are less -> the largest
    (float32)."""
    return _asking(POINTS, 3, _draw, addresses=2, result=types.float32)


@_written
def largest_of_boxes(context, values):  # type: ignore[no-untyped-def]
    """The largest of 16 numbers, none of which is below 0 (float32)."""
    return _asking(BOXES, 0, _largest, result=types.float32)


@_written
def boxes_with(context, values, value):  # type: ignore[no-untyped-def]
    """Which of 16 numbers are this one."""
    return _asking(BOXES, 1, _equal)


@_written
def points_with(context, values, value):  # type: ignore[no-untyped-def]
    """Which of 32 numbers are this one."""
    return _asking(POINTS, 1, _equal)


@_written
def weighted_sum(context, target, rows, offset, weights, count):  # type: ignore[no-untyped-def]
    """Write 16 sums to the first address: over so many rows of 16 numbers, times their weights, from the first to the
    last.

    ``rows`` is the address of their addresses (int64), to each of which the offset is added, ``weights`` that of the
    weights (float32).
    """

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        target, rows, offset, weights, count = arguments
        lanes = _Lanes(builder, BOXES)
        sums = cgutils.alloca_once_value(builder, ir.Constant(lanes.floats, [0.0] * BOXES))
        with cgutils.for_range(builder, count) as loop:
            place = builder.load(builder.gep(builder.inttoptr(rows, _INT64.as_pointer()), [loop.index]))
            weight = builder.load(builder.gep(builder.inttoptr(weights, _FLOAT.as_pointer()), [loop.index]))
            product = builder.fmul(lanes.all(weight), lanes.row(builder.add(place, offset), 0))
            builder.store(builder.fadd(builder.load(sums), product), sums)
        builder.store(builder.load(sums), builder.inttoptr(target, lanes.floats.as_pointer()), align=4)
        return context.get_dummy_value()

    return types.void(*(types.int64,) * 5), generate


@_written
def lowest_bit(context, bits):  # type: ignore[no-untyped-def]
    """The number of the lowest bit that is set, of bits (int64) that are not 0."""

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        return builder.cttz(arguments[0], ir.IntType(1)(1))

    return types.int64(types.int64), generate
