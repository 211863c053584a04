"""The devices that a network can run on here."""

from __future__ import annotations

import re

import torch

from regnet_core.errors import ModelError


def resolve_device(device: str) -> str:
    """The name of a device that is there: "cpu" or "cuda:N".

    Args:
        device: "cpu", "cuda", "cuda:N", or "auto": the GPU that torch uses, where it can use one, else the CPU.

    Raises:
        ModelError: there is no such device.
    """
    gpus = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if device == "cpu" or (device == "auto" and gpus == 0):
        return "cpu"
    if device in ("auto", "cuda") and gpus > 0:
        return f"cuda:{torch.cuda.current_device()}"
    if re.fullmatch(r"cuda:\d+", device) and int(device[5:]) < gpus:
        return f"cuda:{int(device[5:])}"
    there = ", ".join(["auto", "cpu", *(f"cuda:{number}" for number in range(gpus))])
    reason = "" if gpus or not device.startswith("cuda") else f" ({_why_no_gpu()})"
    raise ModelError(f"a network does not run on '{device}' here{reason}; there are {there}")


def _why_no_gpu() -> str:
    if torch.version.cuda is None:
        return f"torch {torch.__version__} was built without CUDA"
    return "torch finds no usable NVIDIA GPU: see nvidia-smi"
