"""Which processors multiply bf16 faster than fp32."""

import pytest

from regnet_core.nn import precision as module
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
    assert fast_bf16(frozenset(["vendor_id", vendor, "fpu", *flags.split()])) is fast


def test_a_processor_without_a_list_of_features_uses_fp32() -> None:
    assert not fast_bf16(frozenset(["Processor", ":", "ARMv8", "Features", ":", "fp", "asimd", "bf16"]))


@pytest.mark.parametrize(
    ("words", "precision"),
    [
        ("GenuineIntel avx512_bf16 avx512_vnni amx_bf16", "bf16"),
        ("GenuineIntel avx512_bf16 avx512_vnni", "int8"),
        ("AuthenticAMD avx512_bf16 avx512_vnni", "int8"),
        ("GenuineIntel avx2 avx_vnni", "int8"),
        ("AuthenticAMD avx2", "fp32"),
        ("", "fp32"),
    ],
)
def test_networks_detect_with_what_the_processor_is_fast_with(
    words: str, precision: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_processor", lambda: frozenset(words.split()))
    monkeypatch.setattr(module, "has_byte_products", lambda: True)
    monkeypatch.setattr(module, "has_fast_bf16", lambda: module.fast_bf16(frozenset(words.split())))
    assert module.cpu_precision.__wrapped__() == precision
    monkeypatch.setattr(module, "has_byte_products", lambda: False)
    without = "bf16" if "amx" in words or "AMD avx512" in words else "fp32"
    assert module.cpu_precision.__wrapped__() == without
