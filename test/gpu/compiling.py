"""Compiles every kernel for GPUs that need not be there: run by test_gpu.py."""

from typing import Any

import pytest
import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

from regnet_core.ops.gpu import farthest_points, moments, nearest, queries, segments

POINTS, WIDE = {"coordinates": "*fp32"}, {"coordinates": "*fp64"}
FOUND = {"found": "*i32", "counts": "*i32", "n": "i32", "most": "i32"}
ROWS = {"indices": "*i64", "offsets": "*i64"}


def _largest(kind: str) -> tuple[Any, dict[str, str], dict[str, Any]]:
    signature = {"values": f"*{kind}", **ROWS, "top": f"*{kind}", "rows": "*i64", "channels": "i32"}
    return segments.largest, signature, {"GATHERED": True, "BLOCK": 128}


KERNELS: list[tuple[Any, dict[str, str], dict[str, Any]]] = [
    (
        farthest_points.draw,
        POINTS | {"nearest": "*fp32", "drawn": "*i64", "n": "i32", "count": "i32", "start": "i32"},
        {"BLOCK": 4096},
    ),
    (queries.first_in_ball, WIDE | {"centres": "*fp64", "squared": "*fp64"} | FOUND, {"BLOCK": 1024}),
    (queries.first_in_box, WIDE | {"boxes": "*fp64"} | FOUND, {"BLOCK": 1024}),
    (
        nearest.nearest_three,
        {"points": "*fp64", "queries": "*fp64", "indices": "*i64", "squared": "*fp64", "n": "i32", "count": "i32"},
        {"BLOCK": 128},
    ),
    (moments.moments, POINTS | {"entries": "*fp32", "n": "i32", "squared": "fp32"}, {"QUERIES": 32, "POINTS": 64}),
    _largest("bf16"),
    _largest("fp32"),
]


@pytest.mark.parametrize("generation", [80])
def test_kernels_compile(generation: int) -> None:
    """To machine code of NVIDIA's GPUs from Ampere (A100, RTX 30) on."""
    for function, signature, constants in KERNELS:
        source = ASTSource(
            fn=function, signature=signature | dict.fromkeys(constants, "constexpr"), constexprs=constants
        )
        done = triton.compile(source, target=GPUTarget("cuda", generation, 32), options={"enable_fp_fusion": False})
        assert len(done.asm["cubin"]) > 1000, function
