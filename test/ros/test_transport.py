"""How messages travel: what is chosen, and what users have chosen before."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

from regnet_ros import transport
from regnet_ros.share import config_file
from regnet_ros.transport import PROFILE, make_room_for_clouds


@pytest.fixture(autouse=True)
def nothing_chosen(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in (PROFILE, "FASTDDS_DEFAULT_PROFILES_FILE", "FASTDDS_BUILTIN_TRANSPORTS"):
        monkeypatch.setenv(name, "")  # put back afterwards, whatever it was
    monkeypatch.chdir(tmp_path)


def free(monkeypatch: pytest.MonkeyPatch, size: int) -> None:
    def usage(path: Any) -> Any:
        return shutil._ntuple_diskusage(size, 0, size)  # type: ignore[attr-defined]

    monkeypatch.setattr(transport.shutil, "disk_usage", usage)


def test_there_is_room_for_a_prepared_cloud(monkeypatch: pytest.MonkeyPatch) -> None:
    free(monkeypatch, 1 << 30)
    make_room_for_clouds()
    assert os.environ[PROFILE] == str(config_file("fastdds_nodes.xml"))
    sizes = [int(tag.text or 0) for tag in ElementTree.parse(os.environ[PROFILE]).iter() if "segment_size" in tag.tag]
    assert sizes and min(sizes) > 4 * 100_000 * 32  # some clouds of as many points as config/regnet.yaml lets through


@pytest.mark.parametrize("name", [PROFILE, "FASTDDS_DEFAULT_PROFILES_FILE", "FASTDDS_BUILTIN_TRANSPORTS"])
def test_what_the_user_has_chosen_stays(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    free(monkeypatch, 1 << 30)
    monkeypatch.setenv(name, "chosen")
    make_room_for_clouds()
    assert os.environ[name] == "chosen" and (name == PROFILE or os.environ[PROFILE] == "")


def test_a_profile_in_the_working_folder_stays_in_force(monkeypatch: pytest.MonkeyPatch) -> None:
    free(monkeypatch, 1 << 30)
    Path("DEFAULT_FASTRTPS_PROFILES.xml").write_text("<dds/>", encoding="utf-8")
    make_room_for_clouds()
    assert os.environ[PROFILE] == ""


def test_little_shared_memory_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    free(monkeypatch, 64 << 20)
    make_room_for_clouds()
    assert os.environ[PROFILE] == ""
