"""Policy files: written and read back, shipped ones valid, and errors that say what is wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from regnet_core.errors import InvalidInputError
from regnet_core.policies import PolicyFile, load_policy, policy_names, save_policy
from regnet_core.policy import AnalyticPolicy

GOOD = "policy: analytic\nconstants: {quality_gain: 0.9, quality_offset: 0.05, slope: 9.0, midpoint: 0.6}\n"


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    file = PolicyFile(
        AnalyticPolicy(0.9, -0.02, 9.5, 0.65),
        {"slope": 0.2, "midpoint": 0.003},
        {"robot": "Baxter, right arm", "reach": {"samples": 20000, "half_side": 0.2}},
    )
    save_policy(tmp_path / "mine.yaml", file)
    assert load_policy(tmp_path / "mine.yaml") == file


def test_the_papers_constants_are_shipped_and_are_the_defaults() -> None:
    policy = load_policy("paper").policy
    assert policy == AnalyticPolicy() == AnalyticPolicy(0.8783, -0.0587, 10.1244, 0.6103)


@pytest.mark.parametrize("name", ["baxter", "panda"])
def test_shipped_calibrations_say_where_they_come_from_and_make_sense(name: str) -> None:
    file = load_policy(name)
    assert name in policy_names()
    assert set(file.errors) == {"quality_gain", "quality_offset", "slope", "midpoint"}
    assert file.origin["reach"]["samples"] >= 10_000
    # The more vertical and the better a grasp, the more likely it is to succeed, and probabilities are such.
    score = file.policy.score(np.array([0.9, 0.9, 0.5]), np.array([1.0, 0.5, 1.0]))
    assert 0.0 < score[1] < score[0] <= 1.05 and score[2] < score[0]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("just a text", "must be a mapping"),
        ("policy: heuristic", "policy must be 'analytic', got 'heuristic'"),
        (GOOD + "speed: 3\n", "unknown key 'speed'; the keys are policy, constants, errors, origin"),
        ("policy: analytic\nconstants: {slope: 9.0}\n", "constants must be quality_gain, .*, got slope"),
        ("policy: analytic\nconstants: 3\n", "constants must be a mapping, got 3"),
        (GOOD.replace("9.0", "steep"), "slope must be a finite number, got 'steep'"),
        (GOOD.replace("9.0", ".nan"), "slope must be a finite number, got nan"),
        (GOOD + "errors: {slop: 1.0}\n", "got one of 'slop'"),
        (GOOD + "errors: {slope: -1.0}\n", "the error of slope must be a finite number of at least 0, got -1.0"),
        ("policy: [", "is no YAML"),
        ("!!python/object/apply:os.system ['true']", "is no YAML"),
    ],
)
def test_a_file_that_cannot_be_used_says_why(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    with pytest.raises(InvalidInputError, match=message) as error:
        load_policy(path)
    assert "bad.yaml" in str(error.value)


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="there is no policy file"):
        load_policy(tmp_path / "none.yaml")
    with pytest.raises(InvalidInputError, match="no policy file 'robby'; there are baxter, panda, paper, or the path"):
        load_policy("robby")


def test_only_yaml_is_written(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match=r"must end in \.yaml, got 'x\.json'"):
        save_policy(tmp_path / "x.json", PolicyFile(AnalyticPolicy()))
