"""Threads that share the turns of a compiled loop with the thread that asks, without Python in between.

To give a piece of work to another thread of Python takes a tenth of a millisecond: it has to be woken, and both need
the interpreter's lock. Most loops of a detection take less than that. Members of a team stay in compiled code: they
look at a board in memory for what there is to do, are at it within two microseconds, and go to sleep when nothing has
come for a while. A piece of work there is the address of a function and that of its arguments.

numba has neither atomic numbers nor addresses of functions; these few operations are written as LLVM's intermediate
code. The threads sleep at a semaphore of POSIX (Linux: sem_wait(3)).
"""

from __future__ import annotations

import atexit
import ctypes
import sys
import threading
import zlib
from collections.abc import Callable
from pathlib import Path
from types import FunctionType
from typing import Any

import numpy as np
import numpy.typing as npt
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from regnet_core.ops.compiled import compiled, inlined

_written: Callable[[Callable[..., Any]], Any] = intrinsic
"""To mypy, what comes of it is as untyped as compiled functions are."""
_INT32, _INT64 = ir.IntType(32), ir.IntType(64)
_PIECE = ir.FunctionType(_INT64, [_INT64] * 3)
"""How a piece of work is called: address of the arguments, start, stop -> whether it failed."""
_LINE = 64
"""Bytes that cores hand over to each other as a whole; what one core writes often has such a line of its own."""
_EPOCH, _OPEN, _NEXT, _INSIDE, _ASLEEP, _ENDED, _JOINED = (_LINE * i for i in range(7))
"""Offsets of numbers on the board: how often there was something to do; whether there still is; the next piece; how
many members are at it; how many sleep; whether they should go home; how often one took part."""
_FUNCTION, _ARGUMENTS, _COUNT, _PIECES, _PLACES, _FAILED = (_LINE * 7 + 8 * i for i in range(6))
"""What there is to do: written by the thread that asks, while the board is not open."""
_SEMAPHORE = _LINE * 8
_BYTES = _LINE * 12
_LOOKS = 2000
"""A member looks so often for something new before it sleeps; each look takes about a quarter of a microsecond."""


# -- operations --------------------------------------------------------------------------------------------------------


def _pointer(builder: Any, address: Any) -> Any:
    return builder.inttoptr(address, _INT64.as_pointer())


@_written
def _read(context, address):  # type: ignore[no-untyped-def]
    """The number at an address, and nothing that comes later is read before it."""

    def code(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        return builder.load_atomic(_pointer(builder, arguments[0]), "seq_cst", 8)

    return types.int64(types.int64), code


@_written
def _write(context, address, value):  # type: ignore[no-untyped-def]
    """Change the number at an address after everything before."""

    def code(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        builder.store_atomic(arguments[1], _pointer(builder, arguments[0]), "seq_cst", 8)
        return context.get_dummy_value()

    return types.void(types.int64, types.int64), code


@_written
def _add(context, address, value):  # type: ignore[no-untyped-def]
    """Add to the number at an address -> what it was before."""

    def code(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        return builder.atomic_rmw("add", _pointer(builder, arguments[0]), arguments[1], "seq_cst")

    return types.int64(types.int64, types.int64), code


@_written
def _replace(context, address, old, new):  # type: ignore[no-untyped-def]
    """Change the number at an address if it is still the old one; whether it was."""

    def code(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        address, old, new = arguments
        pair = builder.cmpxchg(_pointer(builder, address), old, new, "seq_cst", "seq_cst")
        return builder.extract_value(pair, 1)

    return types.boolean(types.int64, types.int64, types.int64), code


@_written
def _call(context, function, arguments, start, stop):  # type: ignore[no-untyped-def]
    """Do a piece of work -> 0, or something else if it failed."""

    def code(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        function = builder.inttoptr(arguments[0], _PIECE.as_pointer())
        return builder.call(function, arguments[1:])

    return types.int64(*(types.int64,) * 4), code


def _of_the_system(name: str, *, given: bool) -> Any:
    """A function of the C library: int name(void), or int name(void *)."""

    @_written
    def call(context, address):  # type: ignore[no-untyped-def]
        def code(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
            kind = ir.FunctionType(_INT32, [_INT64] if given else [])
            function = cgutils.get_or_insert_function(builder.module, kind, name)
            return builder.sext(builder.call(function, arguments if given else []), _INT64)

        return types.int64(types.int64), code

    return call


_sleep, _wake_one, _step_aside = (
    _of_the_system("sem_wait", given=True),
    _of_the_system("sem_post", given=True),
    _of_the_system("sched_yield", given=False),
)


@_written
def _handed_over(context, loop, arguments):  # type: ignore[no-untyped-def]
    """The address of a function that does turns of a compiled loop, and that of a copy of the loop's arguments, which
    is there until the function that asks returns."""
    parts = tuple(arguments.types)
    signature = loop.get_call_type(context, (types.intp, types.intp, *parts), {})
    compiled_loop = loop.dispatcher.get_compile_result(signature)

    def code(context, builder, own_signature, given):  # type: ignore[no-untyped-def]
        descriptor = compiled_loop.fndesc
        context.active_code_library.add_linking_library(compiled_loop.library)
        values = cgutils.unpack_tuple(builder, given[1], len(parts))
        kind = ir.LiteralStructType([value.type for value in values])
        copy = cgutils.alloca_once(builder, kind)
        for number, value in enumerate(values):
            builder.store(value, cgutils.gep_inbounds(builder, copy, 0, number))
        piece = ir.Function(builder.module, _PIECE, builder.function.name + ".piece")
        piece.linkage = "internal"
        inner = ir.IRBuilder(piece.append_basic_block("entry"))
        address, start, stop = piece.args
        taken = inner.inttoptr(address, kind.as_pointer())
        values = [inner.load(cgutils.gep_inbounds(inner, taken, 0, number)) for number in range(len(parts))]
        values = [
            context.cast(inner, value, part, wanted)
            for value, part, wanted in zip(values, parts, signature.args[2:], strict=True)
        ]
        target = context.declare_function(builder.module, descriptor)
        status, _ = context.call_conv.call_function(
            inner, target, descriptor.restype, descriptor.argtypes, [start, stop, *values]
        )
        inner.ret(inner.zext(status.is_error, _INT64))
        return cgutils.pack_array(builder, [builder.ptrtoint(piece, _INT64), builder.ptrtoint(copy, _INT64)])

    return types.UniTuple(types.int64, 2)(loop, arguments), code


# -- the board ---------------------------------------------------------------------------------------------------------


@inlined
def _work(board):  # type: ignore[no-untyped-def]
    function, arguments = _read(board + _FUNCTION), _read(board + _ARGUMENTS)
    count, pieces = _read(board + _COUNT), _read(board + _PIECES)
    piece = _add(board + _NEXT, 1)
    while piece < pieces:
        if _call(function, arguments, count * piece // pieces, count * (piece + 1) // pieces) != 0:
            _write(board + _FAILED, 1)
        piece = _add(board + _NEXT, 1)


@inlined
def _lead(board, function, arguments, count, pieces, helpers):  # type: ignore[no-untyped-def]
    """Have a piece of work done by this thread and at most so many members; whether nothing failed."""
    _write(board + _FUNCTION, function)
    _write(board + _ARGUMENTS, arguments)
    _write(board + _COUNT, count)
    _write(board + _PIECES, pieces)
    _write(board + _PLACES, helpers)
    _write(board + _FAILED, 0)
    _write(board + _NEXT, 0)
    _write(board + _OPEN, 1)
    _add(board + _EPOCH, 1)
    asleep = _read(board + _ASLEEP)
    while asleep > 0 and helpers > 0:
        if _replace(board + _ASLEEP, asleep, asleep - 1):
            _wake_one(board + _SEMAPHORE)
            helpers -= 1
        asleep = _read(board + _ASLEEP)
    _work(board)
    _write(board + _OPEN, 0)
    while _read(board + _INSIDE) > 0:  # it reads the arguments, and works at a piece
        _step_aside(board)
    return _read(board + _FAILED) == 0


@compiled
def _serve(board):  # type: ignore[no-untyped-def]
    """What a member does, until it should go home."""
    seen, idle = 0, 0
    while _read(board + _ENDED) == 0:
        epoch = _read(board + _EPOCH)
        if epoch != seen:
            seen, idle = epoch, 0
            _add(board + _INSIDE, 1)  # from here on who asks waits for this member, unless the board is closed already
            if _read(board + _OPEN) != 0 and _add(board + _PLACES, -1) > 0:
                _add(board + _JOINED, 1)
                _work(board)
            _add(board + _INSIDE, -1)
            continue
        idle += 1
        if idle < _LOOKS:
            _step_aside(board)
            continue
        idle = 0
        _add(board + _ASLEEP, 1)
        if _read(board + _EPOCH) == seen and _read(board + _ENDED) == 0:
            while _sleep(board + _SEMAPHORE) != 0:  # a signal
                pass
            continue
        # Something came meanwhile. Where it has already been taken for one that sleeps, it was woken, too.
        asleep = _read(board + _ASLEEP)
        while asleep > 0 and not _replace(board + _ASLEEP, asleep, asleep - 1):
            asleep = _read(board + _ASLEEP)
        if asleep <= 0:
            while _sleep(board + _SEMAPHORE) != 0:
                pass


@compiled
def _end(board):  # type: ignore[no-untyped-def]
    _write(board + _ENDED, 1)
    while _read(board + _ASLEEP) > 0:
        _add(board + _ASLEEP, -1)
        _wake_one(board + _SEMAPHORE)


# -- for Python --------------------------------------------------------------------------------------------------------


def can_have_teams() -> bool:
    """Whether the system has what teams need."""
    return sys.platform.startswith("linux")


def _stay(memory: npt.NDArray[np.uint8], board: int) -> None:
    """What a member's thread does; it holds the board's memory as long."""
    _serve(board)


class Team:
    """So many threads besides the one that asks; one loop at a time."""

    def __init__(self, members: int) -> None:
        self.members = members
        self._memory = np.zeros(_BYTES + _LINE, np.uint8)
        self._board = -(-self._memory.ctypes.data // _LINE) * _LINE
        if ctypes.CDLL(None).sem_init(ctypes.c_void_p(self._board + _SEMAPHORE), 0, 0) != 0:
            raise OSError("the system has no semaphores for threads")
        self.threads = [
            threading.Thread(target=_stay, args=(self._memory, self._board), name=f"regnet-ops {number}", daemon=True)
            for number in range(members)
        ]
        try:
            for thread in self.threads:
                thread.start()
        except BaseException:  # the system has no more threads
            _end(self._board)
            raise
        atexit.register(self.end)

    def run(self, shared: Any, count: int, pieces: int, helpers: int, arguments: tuple[Any, ...]) -> bool:
        """Do all turns of a loop, in so many pieces, with at most so many members; whether nothing failed."""
        return bool(shared(self._board, count, pieces, helpers, *arguments))

    def end(self) -> None:
        """Send the members home."""
        _end(self._board)
        for thread in self.threads:
            thread.join(1.0)
        atexit.unregister(self.end)  # a thread that is late keeps the memory

    def sleeping(self) -> int:
        """How many members sleep."""
        return self._number(_ASLEEP)

    def joined(self) -> int:
        """How often a member has taken part."""
        return self._number(_JOINED)

    def _number(self, offset: int) -> int:
        return int(ctypes.c_int64.from_address(self._board + offset).value)


_VERSION = zlib.crc32(Path(__file__).read_bytes())
"""Of this file: what is made for another one, and lies in numba's cache, must not be used with its boards."""


def _template(version: int) -> Any:
    def all_turns(board, count, pieces, helpers, *arguments):  # type: ignore[no-untyped-def]
        if version < 0:  # never; numba's cache asks for what a function refers to outside of it
            return False
        function, given = _handed_over(loop, arguments)  # type: ignore[name-defined]  # noqa: F821
        return _lead(board, function, given, count, pieces, helpers)

    return all_turns


def shared(loop: Any) -> Any:
    """``shared(board, count, pieces, helpers, *arguments)`` of a compiled ``loop(start, stop, *arguments)``.

    numba tells functions apart by where they stand in a file: this one stands where the loop does.
    """
    source, template = loop.py_func, _template(_VERSION)
    name, qualified = f"{source.__name__}_shared", f"{source.__qualname__}_shared"
    code = template.__code__.replace(
        co_filename=source.__code__.co_filename,
        co_firstlineno=source.__code__.co_firstlineno,
        co_name=name,
        co_qualname=qualified,
    )
    names = {"loop": loop, "_handed_over": _handed_over, "_lead": _lead, "__name__": source.__module__}
    function = FunctionType(code, names, name, None, template.__closure__)
    function.__qualname__, function.__module__ = qualified, source.__module__
    return compiled(function)
