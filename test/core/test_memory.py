"""Freed memory stays with the process, so that the next cloud's arrays need no new pages of the system."""

import subprocess
import sys

CODE = """
import ctypes
import resource
import sys

import numpy as np

from regnet_core.memory import keep_freed_memory

ctypes.CDLL(None).prctl(41, 1, 0, 0, 0)  # no huge pages: PR_SET_THP_DISABLE
if sys.argv[1] == "keep":
    assert keep_freed_memory()


def faults():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt


def work():
    blocks = [np.ones(300_000) for _ in range(20)]  # 2.4 MB or nearly 600 pages each
    del blocks


work()
before = faults()
for _ in range(10):
    work()
print(faults() - before)
"""


def page_faults(how: str) -> int:
    return int(subprocess.run([sys.executable, "-c", CODE, how], capture_output=True, text=True, check=True).stdout)


def test_arrays_of_a_clouds_size_use_the_memory_of_those_before_them() -> None:
    assert page_faults("leave") > 10 * 20 * 300
    assert page_faults("keep") < 1000
