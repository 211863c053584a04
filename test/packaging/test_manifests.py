"""The two packages say the same about themselves everywhere, and declare what they import."""

import ast
import importlib.metadata
import re
import sys
from collections.abc import Iterable
from pathlib import Path
from xml.etree import ElementTree

import pytest

import regnet_core

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ElementTree.parse(ROOT / "package.xml").getroot()
MESSAGES = ElementTree.parse(ROOT / "msg_defs" / "package.xml").getroot()
INSTALLED = importlib.metadata.metadata("regnet_ros")
# Import names that differ from the name of what is installed.
DISTRIBUTIONS = {
    "PIL": "pillow",
    "fcl": "python-fcl",
    "mcap_ros2": "mcap-ros2-support",
    "open3d": "open3d-cpu",
    "yaml": "pyyaml",
}
ROSDEP = {"numpy": "python3-numpy", "pillow": "python3-pil", "pyyaml": "python3-yaml", "scipy": "python3-scipy"}
# Import names of ROS packages that are called otherwise.
ROS_MODULES = {"tf2_ros_py": "tf2_ros"}
OWN = {"benchmarks", "regnet_core", "regnet_ros"}


def normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def requirements(extra: str | None) -> set[str]:
    """Names of what the installed project requires always (None), or for an extra."""
    found = set()
    for line in importlib.metadata.requires("regnet_ros") or []:
        name = normal(re.match(r"[\w.-]+", line)[0])
        wanted = re.search(r"extra == ['\"](\w+)['\"]", line)
        if (wanted[1] if wanted else None) == extra:
            found.add(name)
    return found


def third_party(files: Iterable[Path]) -> dict[str, Path]:
    """Top-level names of the packages that files import, anywhere in them, with one of the files for each."""
    found: dict[str, Path] = {}
    for path in files:
        for node in ast.walk(ast.parse(path.read_text())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and node.level == 0:
                names.append(node.module or "")
            found.update({name.split(".")[0]: path for name in names})
    return {name: path for name, path in found.items() if name not in OWN | sys.stdlib_module_names}


def sources(*folders: str) -> list[Path]:
    return [path for folder in folders for path in sorted((ROOT / folder).rglob("*.py"))]


def ros_packages() -> set[str]:
    """Names of the ROS packages in this environment."""
    return {path.name for path in Path(sys.prefix, "share", "ament_index", "resource_index", "packages").iterdir()}


def ros_dependencies(*tags: str) -> set[str]:
    """Packages and rosdep keys that package.xml names for running, and with further tags."""
    return {node.text or "" for node in PACKAGE if node.tag in ("depend", "exec_depend", *tags)}


def test_installed_metadata_are_those_of_package_xml() -> None:
    assert normal(INSTALLED["Name"]) == normal(PACKAGE.findtext("name", ""))
    assert INSTALLED["Version"] == PACKAGE.findtext("version")
    assert INSTALLED["Summary"] == PACKAGE.findtext("description")
    assert INSTALLED["License"] == PACKAGE.findtext("license")
    assert INSTALLED["Maintainer"] == PACKAGE.findtext("maintainer")
    assert INSTALLED["Maintainer-email"] == PACKAGE.find("maintainer").get("email")
    assert regnet_core.__version__ == PACKAGE.findtext("version")


@pytest.mark.parametrize("tag", ["version", "license", "maintainer"])
def test_both_packages_agree(tag: str) -> None:
    assert MESSAGES.findtext(tag) == PACKAGE.findtext(tag)


def test_build_types_and_licence_text() -> None:
    assert PACKAGE.findtext("export/build_type") == "ament_python"
    assert MESSAGES.findtext("export/build_type") == "ament_cmake"
    assert MESSAGES.findtext("member_of_group") == "rosidl_interface_packages"
    text = (ROOT / PACKAGE.find("license").get("file")).read_text()
    assert "Apache License" in text and "Version 2.0" in text and "END OF TERMS AND CONDITIONS" in text


def test_index_marker_has_the_name_of_the_package() -> None:
    assert [path.name for path in (ROOT / "resource").iterdir()] == [PACKAGE.findtext("name")]


def test_nodes_import_declared_ros_packages_only() -> None:
    ros = {name for name in third_party(sources("regnet_ros")) if name in ros_packages()}
    assert "rclpy" in ros
    assert ros <= ros_dependencies()


def test_core_imports_no_ros() -> None:
    assert "numpy" in third_party(sources("regnet_core"))
    assert not set(third_party(sources("regnet_core"))) & {"rclpy", "launch", "tf2_ros", *ros_packages()}


def test_every_python_package_that_is_imported_is_declared() -> None:
    learning = [*sources("regnet_core/training"), ROOT / "regnet_core" / "cli" / "train.py"]
    data_only = sources("regnet_core/data", "regnet_core/evaluation", "regnet_core/picking", "regnet_core/sim")
    robots, gpu = sources("regnet_core/robots"), sources("regnet_core/ops/gpu")
    some = data_only + robots + learning + gpu
    always = [path for path in sources("regnet_core", "regnet_ros") if path not in some]
    data = requirements(None) | requirements("data")
    train, arms = requirements("train"), requirements("robots")
    everything = data | requirements("dev") | requirements("cluster") | requirements("gpu") | arms
    assert "regnet-ros" in train & arms  # with the extra data, which both need as well
    for files, declared, packages in (
        (always, requirements(None), ros_dependencies()),
        ([path for path in data_only if path not in learning], data | requirements("cluster"), set()),
        (robots, data | arms, set()),
        (gpu, requirements(None) | requirements("gpu"), set()),
        (learning, data | train, set()),
        (sources("benchmarks", "tools", "test"), everything | train, ros_dependencies("test_depend")),
    ):
        known = {path.stem for path in files} | packages | {ROS_MODULES.get(name, name) for name in packages}
        for name, path in third_party(files).items():
            if name not in known:
                assert normal(DISTRIBUTIONS.get(name, name)) in declared, f"{path} imports {name}, which setup.py lacks"


def test_what_is_required_always_is_imported() -> None:
    imported = {normal(DISTRIBUTIONS.get(name, name)) for name in third_party(sources("regnet_core", "regnet_ros"))}
    assert requirements(None) - imported == set()


def test_rosdep_keys_are_in_package_xml() -> None:
    assert requirements(None) & set(ROSDEP) == set(ROSDEP)
    assert set(ROSDEP.values()) <= ros_dependencies()
