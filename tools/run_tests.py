"""Checks style and types and runs all tests, in two processes at a time: most tests keep one core busy and no more.

python tools/run_tests.py [ARGUMENT ...]

Arguments go to both runs of pytest. The output of the tests of nodes comes at the end; the exit code is 0 where
everything passes.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
NODES = ("ros",)
"""Folders of the one half; all others are the other half. Tests of nodes have a ROS domain of their own."""
FIRST = "packaging"
"""Of the other half: what runs while the tests of nodes compile the loops that both halves need."""


def main() -> int:
    """Run everything; the exit code."""
    folders = sorted(path.name for path in (ROOT / "test").iterdir() if any(path.glob("test_*.py")))
    folders.sort(key=lambda name: name != FIRST)
    lint = subprocess.Popen(["make", "--no-print-directory", "lint-only"], cwd=ROOT)
    with tempfile.TemporaryFile() as output:
        nodes = subprocess.Popen(
            _pytest([name for name in folders if name in NODES]), cwd=ROOT, stdout=output, stderr=subprocess.STDOUT
        )
        others = subprocess.run(_pytest([name for name in folders if name not in NODES]), cwd=ROOT, check=False)
        codes = [lint.wait(), others.returncode, nodes.wait()]
        output.seek(0)
        sys.stdout.flush()
        sys.stdout.buffer.write(output.read())
        sys.stdout.flush()
    for name, code in zip(("style and types", "tests", "tests of nodes"), codes, strict=True):
        if code != 0:
            print(f"{name}: failed, see above")
    return int(any(codes))


def _pytest(folders: list[str]) -> list[str]:
    # Not the same cache for both.
    return [
        sys.executable, "-m", "pytest", "-o", f"cache_dir=.pytest_cache/{folders[0]}", *sys.argv[1:],
        *(f"test/{name}" for name in folders),
    ]  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
