"""Write constraints.txt anew: the newest versions of all that set-up installs, for every supported Python.

Run it with each of these Pythons at hand, try `make clean test` with each, and commit the result:

    python3 tools/update_constraints.py python3.11 python3.12
"""

import argparse
import json
import re
import subprocess
import tempfile
from collections.abc import Mapping
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
TARGET = ROOT / "constraints.txt"
EXTRAS = "cluster,data,dev,msgs,robots,ros,train"
ALONE = ("robosuite",)
"""What set-up installs without its dependencies (tools/setup_env.py)."""
HEADER = """\
# Versions of all that set-up installs, direct and indirect, for every Python that it supports.
# Written by tools/update_constraints.py.
"""


def resolve(python: str) -> tuple[str, dict[str, str]]:
    """What pip would install with this Python into an empty environment.

    Returns:
        The Python's version, such as "3.12", and name: version.
    """
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run([python, "-m", "venv", folder], check=True)
        contents = []
        for wanted in ([f"{ROOT}[{EXTRAS}]"], ["--no-deps", *ALONE]):
            report = Path(folder) / "report.json"
            command = [f"{folder}/bin/python", "-m", "pip", "install", "--quiet", "--dry-run", "--report", str(report)]
            subprocess.run([*command, *wanted], check=True)
            contents.append(json.loads(report.read_text()))
    packages = [entry["metadata"] for content in contents for entry in content["install"]]
    found = {re.sub(r"[-_.]+", "-", package["name"]).lower(): package["version"] for package in packages}
    del found["regnet-ros"]
    return contents[0]["environment"]["python_version"], found


def lines(resolved: Mapping[str, Mapping[str, str]]) -> list[str]:
    """The constraints: one line for a package of one version, else one for each Python.

    Args:
        resolved: Python's version: (name: version).
    """
    result = []
    for name in sorted({name for packages in resolved.values() for name in packages}):
        versions = {python: packages[name] for python, packages in resolved.items() if name in packages}
        if len(set(versions.values())) == 1:
            result.append(f"{name}=={next(iter(versions.values()))}")
        else:
            result += [f'{name}=={version}; python_version == "{python}"' for python, version in versions.items()]
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description="Write constraints.txt anew.")
    parser.add_argument("python", nargs="+", help="a command or path, one for each supported version")
    resolved = dict(sorted(resolve(python) for python in parser.parse_args().python))
    TARGET.write_text(HEADER + "\n".join(lines(resolved)) + "\n")
    print(f"{TARGET}: {len(lines(resolved))} lines for Python {', '.join(resolved)}")


if __name__ == "__main__":
    main()
