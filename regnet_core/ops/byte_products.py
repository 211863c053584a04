"""Products of bytes by the processor's instruction for them: vpdpbusd, which multiplies four pairs of bytes for each of
a register's numbers of 32 bits and adds them up (AVX-512 VNNI, AVX-VNNI).

numba has no such instruction, but lets functions be written as LLVM's intermediate code; these are compiled with the
loops around them (ops/bytes.py), so that no compiler and no library is needed. On other processors the same numbers
come from ordinary instructions, many times slower.

A product is made of blocks of ``ROWS`` rows and ``COLUMNS`` columns whose sums stay in registers. The weights lie in
the order in which blocks read them (``packed``): for each block of columns, four inputs of each of its columns, then
the next four. Sums are exact; what becomes of them is computed in float32.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba
import numpy as np
import numpy.typing as npt
from llvmlite import binding, ir
from numba import types
from numba.extending import intrinsic

_INT32, _INT64, _FLOAT = ir.IntType(32), ir.IntType(64), ir.FloatType()


def _instruction() -> str:
    """The widest unit that multiplies bytes: "avx512", "avx", or "" for none."""
    settings: Any = numba.config
    if settings.CPU_NAME or settings.CPU_FEATURES is not None:  # what numba was told to compile for
        features = set((settings.CPU_FEATURES or "").split(","))
    else:
        features = {f"+{name}" for name, there in binding.get_host_cpu_features().items() if there}
    if {"+avx512f", "+avx512vnni"} <= features:
        return "avx512"
    return "avx" if "+avxvnni" in features else ""


_UNIT = _instruction()
_LANES = 16 if _UNIT == "avx512" else 8
"""Sums in a register."""
_REGISTERS = 2
"""In a row of a block."""
ROWS = 12 if _UNIT == "avx512" else 6
"""Of a block: with two registers each, as many as leave room for the factors among the 32 or 16 registers."""
COLUMNS = _LANES * _REGISTERS
"""Of a block."""


def has_byte_products() -> bool:
    """Whether this processor has the instruction."""
    return bool(_UNIT)


def packed(weight: npt.NDArray[np.int8]) -> npt.NDArray[np.int8]:
    """Weights (C, K) in the order of the blocks, with C rounded up to blocks and K to fours by zeros."""
    columns, inputs = weight.shape
    blocks, fours = -(-columns // COLUMNS), -(-inputs // 4)
    padded = np.zeros((blocks * COLUMNS, fours * 4), np.int8)
    padded[:columns, :inputs] = weight
    return np.ascontiguousarray(padded.reshape(blocks, COLUMNS, fours, 4).transpose(0, 2, 1, 3)).reshape(-1)


class _Block:
    """Writes the code of a block: rows of registers, of which each part holds numbers of some columns."""

    def __init__(self, builder: Any) -> None:
        self.build = builder
        self.floats, self.sums = ir.VectorType(_FLOAT, _LANES), ir.VectorType(_INT32, _LANES)
        self.keys = [(row, part) for row in range(ROWS) for part in range(_REGISTERS)]

    def at(self, address: Any, kind: Any, *offsets: Any) -> Any:
        """The pointer so many bytes behind an address."""
        for offset in offsets:
            address = self.build.add(address, offset if isinstance(offset, ir.Value) else _INT64(offset))
        return self.build.inttoptr(address, kind.as_pointer())

    def loaded(self, address: Any, kind: Any, *offsets: Any) -> list[Any]:
        """A row of registers from memory."""
        return [
            self.build.load(self.at(address, kind, *offsets, 4 * _LANES * part), align=1) for part in range(_REGISTERS)
        ]

    def in_all_lanes(self, value: Any, kind: Any) -> Any:
        """A register of which each number is the same."""
        nothing = ir.Constant(kind, ir.Undefined)
        one = self.build.insert_element(nothing, value, _INT32(0))
        return self.build.shuffle_vector(one, nothing, ir.Constant(self.sums, [0] * _LANES))

    def sum_over(self, count: Any, before: dict[Any, Any], added: Callable[[Any, dict[Any, Any]], None]) -> Any:
        """``before`` after ``added`` has changed it for each of a number of steps, which may be 0."""
        build = self.build
        start = build.block
        check, body, end = (build.append_basic_block(name) for name in ("check", "step", "end"))
        build.branch(check)
        build.position_at_end(check)
        step = build.phi(_INT64)
        step.add_incoming(_INT64(0), start)
        total = {key: build.phi(value.type) for key, value in before.items()}
        for key, value in before.items():
            total[key].add_incoming(value, start)
        build.cbranch(build.icmp_signed("<", step, count), body, end)
        build.position_at_end(body)
        changed = dict(total)
        added(step, changed)
        step.add_incoming(build.add(step, _INT64(1)), build.block)
        for key, value in changed.items():
            total[key].add_incoming(value, build.block)
        build.branch(check)
        build.position_at_end(end)
        return total

    def plus_product(self, total: Any, one: Any, other: Any) -> Any:
        """total + one * other, of floats."""
        return self.build.fadd(total, self.build.fmul(one, other, flags=("contract",)), flags=("contract",))

    def limited(self, value: Any, least: Any, most: Any) -> Any:
        """A register of floats without what is below and above."""
        value = self.build.select(self.build.fcmp_ordered(">", value, least), value, least)
        return value if most is None else self.build.select(self.build.fcmp_ordered("<", value, most), value, most)

    def store(self, value: Any, out: Any, row: Any, part: int, *, as_bytes: bool) -> None:
        """A register of floats to memory; as bytes it must be from 0 to less than 256."""
        if as_bytes:
            kind = ir.VectorType(ir.IntType(8), _LANES)
            value = self.build.trunc(self.build.fptosi(value, self.sums), kind)
            self.build.store(value, self.at(out, kind, row, _LANES * part), align=1)
        else:
            self.build.store(value, self.at(out, self.floats, row, 4 * _LANES * part), align=1)

    def plus_dot(self, total: Any, unsigned: Any, signed: Any) -> Any:
        """total + the products of four unsigned and four signed bytes, in every lane."""
        build, kind = self.build, self.sums
        if _UNIT:
            name = f"llvm.x86.avx512.vpdpbusd.{32 * _LANES}"
            instruction = build.module.globals.get(name) or ir.Function(
                build.module, ir.FunctionType(kind, [kind, kind, kind]), name
            )
            return build.call(instruction, [total, unsigned, signed])
        as_bytes, as_numbers = ir.VectorType(ir.IntType(8), 4 * _LANES), ir.VectorType(_INT32, 4 * _LANES)
        products = build.mul(
            build.zext(build.bitcast(unsigned, as_bytes), as_numbers),
            build.sext(build.bitcast(signed, as_bytes), as_numbers),
        )
        for first in range(4):
            every_fourth = ir.Constant(kind, list(range(first, 4 * _LANES, 4)))
            total = build.add(total, build.shuffle_vector(products, products, every_fourth))
        return total


def _write_products(block: _Block, arguments: Any, as_bytes: bool) -> None:
    rows, stride, weight, fours, scale, bias, least, out, out_stride = arguments
    build = block.build

    def four_inputs(step: Any, total: dict[Any, Any]) -> None:
        weights = block.loaded(weight, block.sums, build.mul(step, _INT64(4 * COLUMNS)))
        for row in range(ROWS):
            offset = build.add(build.mul(stride, _INT64(row)), build.mul(step, _INT64(4)))
            inputs = block.in_all_lanes(build.load(block.at(rows, _INT32, offset), align=1), block.sums)
            for part in range(_REGISTERS):
                total[row, part] = block.plus_dot(total[row, part], inputs, weights[part])

    nothing = {key: ir.Constant(block.sums, [0] * _LANES) for key in block.keys}
    total = block.sum_over(fours, nothing, four_inputs)
    factors, added = block.loaded(scale, block.floats), block.loaded(bias, block.floats)
    lowest = block.in_all_lanes(least, block.floats)
    most = ir.Constant(block.floats, [255.0] * _LANES) if as_bytes else None
    for row, part in block.keys:
        value = block.plus_product(added[part], build.sitofp(total[row, part], block.floats), factors[part])
        value = block.limited(value, lowest, most)
        block.store(value, out, build.mul(out_stride, _INT64(row)), part, as_bytes=as_bytes)


def _write_sum(block: _Block, arguments: Any) -> None:
    (
        first, last, shift, start, start_stride, bias, gathers, indices, values, values_stride,
        shares, share_stride, columns_count, columns, weight, weight_stride, out, out_stride,
    ) = arguments  # fmt: skip
    build = block.build
    numbers = []
    for row in range(ROWS):  # what is beyond the last row is the last one again
        number, end = build.add(first, _INT64(row)), build.sub(last, _INT64(1))
        numbers.append(build.select(build.icmp_signed("<", number, end), number, end))

    added = block.loaded(bias, block.floats, shift)
    total = {}
    for row, part in block.keys:
        offset = build.mul(numbers[row], start_stride)
        total[row, part] = build.fadd(block.loaded(start, block.floats, shift, offset)[part], added[part])

    def gather(step: Any, total: dict[Any, Any]) -> None:
        for row in range(ROWS):
            entry = build.add(build.mul(numbers[row], gathers), step)
            index = build.load(block.at(indices, _INT64, build.mul(entry, _INT64(8))), align=8)
            share = build.load(block.at(shares, _FLOAT, build.mul(entry, share_stride)), align=4)
            share = block.in_all_lanes(share, block.floats)
            found = block.loaded(values, block.floats, shift, build.mul(index, values_stride))
            for part in range(_REGISTERS):
                total[row, part] = block.plus_product(total[row, part], share, found[part])

    def column(step: Any, total: dict[Any, Any]) -> None:
        weights = block.loaded(weight, block.floats, shift, build.mul(step, weight_stride))
        for row in range(ROWS):
            entry = build.add(build.mul(numbers[row], columns_count), step)
            own = build.load(block.at(columns, _FLOAT, build.mul(entry, _INT64(4))), align=4)
            own = block.in_all_lanes(own, block.floats)
            for part in range(_REGISTERS):
                total[row, part] = block.plus_product(total[row, part], own, weights[part])

    total = block.sum_over(gathers, total, gather)
    total = block.sum_over(columns_count, total, column)
    zero, half, most = (ir.Constant(block.floats, [number] * _LANES) for number in (0.0, 0.5, 255.0))
    for row, part in block.keys:
        value = block.limited(block.plus_product(half, total[row, part], most), zero, most)
        block.store(value, out, build.mul(out_stride, _INT64(row)), part, as_bytes=True)


_ADDRESS, _NUMBER = types.uintp, types.intp


def _products(as_bytes: bool) -> Any:
    @intrinsic
    def products(typing_context, rows, stride, weight, fours, scale, bias, least, out, out_stride):  # type: ignore[no-untyped-def]
        a, n = _ADDRESS, _NUMBER
        signature = types.void(a, n, a, n, a, a, types.float32, a, n)

        def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            _write_products(_Block(builder), arguments, as_bytes)
            return context.get_dummy_value()

        return signature, code

    return products


products_to_bytes = _products(as_bytes=True)
"""For compiled functions: a block of max(sums * scale + bias, least), cut off at 255, without the part after the point.

Arguments, of which addresses are whole numbers: the rows' address and distance in bytes; the address of the block's
weights and how many fours of inputs there are; the addresses of the scales and biases of the columns; ``least``,
float32; the address of the output and the distance of its rows in bytes.
"""
products_to_floats = _products(as_bytes=False)
"""The same, with all of the sums * scale + bias that is above ``least``, in float32."""


@intrinsic
def sum_to_bytes(  # type: ignore[no-untyped-def]
    typing_context, first, last, shift, start, start_stride, bias, gathers, indices, values, values_stride,
    shares, share_stride, columns_count, columns, weight, weight_stride, out, out_stride,
):  # fmt: skip
    """For compiled functions: a block of 255 times sums of floats, rounded, from 0 to 255.

    Row e is start[e] + bias + the sum over j of shares[e, j] * values[indices[e, j]] + columns[e] @ weight.

    Args:
        first, last: the rows of the block are from ``first`` on, and ``last`` is the first one that is not there; what
            the block has room for beyond is not to be used.
        shift: of the block's columns in ``start``, ``bias``, ``values`` and ``weight`` [bytes].
        start, start_stride, bias: address of float32, the distance of rows [bytes], 0 for one that all have; address.
        gathers, indices, values, values_stride, shares, share_stride: how many j; addresses of int64 and float32; the
            distance of rows [bytes]; address of float32, and the distance of one to the next [bytes].
        columns_count, columns, weight, weight_stride: how many columns; addresses of float32, distance of rows [bytes].
        out, out_stride: address of bytes, and their rows' distance.
    """
    a, n = _ADDRESS, _NUMBER
    signature = types.void(n, n, n, a, n, a, n, a, a, n, a, n, n, a, a, n, a, n)

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        _write_sum(_Block(builder), arguments)
        return context.get_dummy_value()

    return signature, code
