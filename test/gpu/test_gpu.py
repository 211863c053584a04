"""The kernels for GPUs, each in a process of its own: whether Triton interprets is decided when it is loaded."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

pytest.importorskip("triton")


def _outcome(script: str, **environment: str) -> tuple[int, str]:
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(Path(__file__).with_name(script))]
    there = {**os.environ, **environment}
    done = subprocess.run(command, env=there, capture_output=True, text=True, timeout=300, check=False)
    return done.returncode, done.stdout + done.stderr


def test_kernels_compute_what_the_operations_do() -> None:
    """On a GPU where there is one, else in Triton's interpreter."""
    interpreted = {} if torch.cuda.is_available() else {"TRITON_INTERPRET": "1"}
    code, output = _outcome("kernels.py", **interpreted)
    assert code == 0 and " passed" in output, output


def test_kernels_compile_for_gpus_that_are_not_here(tmp_path: Path) -> None:
    code, output = _outcome("compiling.py", TRITON_CACHE_DIR=str(tmp_path))
    assert code == 0 and " passed" in output, output
