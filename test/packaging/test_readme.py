"""The README against the code: parameter tables, files, targets, options and the Python example."""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
TEXT = (ROOT / "README.md").read_text(encoding="utf-8")


def test_the_parameter_tables_are_those_of_the_nodes() -> None:
    done = subprocess.run([sys.executable, ROOT / "tools" / "parameter_tables.py", "--check"], cwd=ROOT, check=False)
    assert done.returncode == 0, "run python tools/parameter_tables.py"


def test_every_file_it_names_exists() -> None:
    names = set(re.findall(r"`((?:tools|bags|rviz|launch|config|docs|test|msg_defs)/[\w./]*)`", TEXT))
    names |= set(re.findall(r"\]\(((?:docs)/[\w./]+)\)", TEXT))
    names |= {f"regnet_core/{name}" for name in re.findall(r"\(`(\w+\.py|\w+/)`[,)]", TEXT)}
    missing = [name for name in names if not (ROOT / name).exists()]
    assert len(names) > 8
    assert missing == []


def test_every_make_target_it_names_exists() -> None:
    targets = set(re.findall(r"make (demo|test|setup|lint|clean|msgs)\b", TEXT))
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    assert {"demo", "test", "setup"} <= targets
    assert all(re.search(rf"^{target}:", makefile, flags=re.M) for target in targets)


def test_every_option_it_shows_is_one_of_the_command() -> None:
    shown = set(re.findall(r"regnet detect [^\n]*", TEXT))
    options = {option for line in shown for option in re.findall(r"--[a-z-]+", line)}
    help_text = subprocess.run(
        [sys.executable, "-c", "import sys; from regnet_core.cli import main; sys.exit(main())", "detect", "--help"],
        env={**os.environ, "COLUMNS": "200", "NO_COLOR": "1"}, capture_output=True, text=True, check=True,
    ).stdout  # fmt: skip
    assert "--gripper-width" in options
    assert [option for option in options if option not in help_text] == []


def test_the_python_example_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", TEXT, flags=re.S)
    rng = np.random.default_rng(0)
    table = np.column_stack([rng.uniform(-0.3, 0.3, (15000, 2)), np.zeros(15000)])
    top = rng.uniform([-0.02, -0.05, 0.1], [0.02, 0.05, 0.1], (1500, 3))
    np.save(tmp_path / "cloud.npy", np.concatenate([table, top]))
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "README.md", "exec"), {})
    assert "StepReport" in capsys.readouterr().out
    assert (tmp_path / "grasps.npz").exists()
