"""Which processors multiply bf16 faster than fp32."""

import pytest

from regnet_core.nn.precision import fast_bf16


@pytest.mark.parametrize(
    ("vendor", "flags", "fast"),
    [
        ("GenuineIntel", "avx512f avx512_bf16 amx_bf16 amx_tile", True),
        ("GenuineIntel", "avx512f avx512_bf16", False),  # a virtual machine that hides AMX
        ("AuthenticAMD", "avx512f avx512_bf16", True),
        ("AuthenticAMD", "avx2", False),
        ("GenuineIntel", "avx2 avx512f", False),
    ],
)
def test_bf16_is_used_where_it_is_fast(vendor: str, flags: str, fast: bool) -> None:
    assert fast_bf16(f"vendor_id\t: {vendor}\nmodel name\t: a processor\nflags\t\t: fpu {flags}\n") is fast


def test_a_processor_without_a_list_of_features_uses_fp32() -> None:
    assert not fast_bf16("Processor\t: ARMv8\nFeatures\t: fp asimd bf16\n")
