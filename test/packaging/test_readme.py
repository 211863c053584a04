"""The README against the code: parameter tables, files, targets, options and the Python example."""

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from regnet_core.data.generation.executors import LocalExecutor
from regnet_core.data.generation.run import generate
from regnet_core.data.generation.settings import GenerationSettings
from regnet_core.data.labels.candidates import CandidateConfig

ROOT = Path(__file__).resolve().parents[2]
TEXT = (ROOT / "README.md").read_text(encoding="utf-8")
DATASET_TEXT = (ROOT / "docs" / "dataset.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"```python\n(.*?)```", TEXT, flags=re.S)


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


@pytest.mark.parametrize("command", ["detect", "generate", "inspect"])
def test_every_option_it_shows_is_one_of_the_command(command: str) -> None:
    shown = set(re.findall(rf"^regnet {command} [^\n]*", TEXT + DATASET_TEXT, flags=re.M))
    options = {option for line in shown for option in re.findall(r"--[a-z-]+", line)}
    help_text = subprocess.run(
        [sys.executable, "-c", "import sys; from regnet_core.cli import main; sys.exit(main())", command, "--help"],
        env={**os.environ, "COLUMNS": "200", "NO_COLOR": "1"}, capture_output=True, text=True, check=True,
    ).stdout  # fmt: skip
    assert options
    assert [option for option in options if option not in help_text] == []


def test_the_detection_example_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    code = EXAMPLES[0]
    rng = np.random.default_rng(0)
    table = np.column_stack([rng.uniform(-0.3, 0.3, (15000, 2)), np.zeros(15000)])
    top = rng.uniform([-0.02, -0.05, 0.1], [0.02, 0.05, 0.1], (1500, 3))
    front = rng.uniform([-0.02, -0.05, 0.0], [0.02, -0.05, 0.1], (1500, 3))
    np.save(tmp_path / "cloud.npy", np.concatenate([table, top, front]))
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "README.md", "exec"), {})
    assert "StepReport" in capsys.readouterr().out
    assert (tmp_path / "grasps.npz").exists()


def test_the_data_set_examples_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    settings = GenerationSettings(scenes=1, kinds=(("single", 1.0),), objects=1, candidates=CandidateConfig(points=80))
    for folder in ("out/data", "data/train"):
        generate(Path(folder), settings, LocalExecutor(1))
    exec(compile(EXAMPLES[1], "README.md", "exec"), {})
    assert "Outcome." in capsys.readouterr().out
    (code,) = re.findall(r"```python\n(.*?)```", DATASET_TEXT, flags=re.S)
    found: dict[str, Any] = {}
    exec(compile(code.replace("num_workers=2", "num_workers=0"), "docs/dataset.md", "exec"), found)
    assert next(iter(found["loader"])).points.shape == (6, 25600, 3)
