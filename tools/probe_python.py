"""Whether the Python that runs this file can carry the environment: prints "ok <version> <path>", or what is wrong.

Written for any Python 3, also those that are too old, so that they can say so.
"""

import os
import platform
import struct
import sys
import sysconfig

VERSIONS = ((3, 12), (3, 11))  # CPython versions that every wheel in constraints.txt exists for.
GLIBC = (2, 31)  # The oldest that those wheels are made for.


def fault():
    # type: () -> str
    """What keeps this Python from being used, with the remedy; empty if nothing does."""
    version = sys.version_info[:2]
    package = "python" + str(version[0]) + "." + str(version[1])
    if version not in VERSIONS:
        return "it is " + platform.python_version() + ", and only for 3.12 and 3.11 all packages exist"
    if platform.python_implementation() != "CPython" or struct.calcsize("P") != 8:
        return "it is no 64-bit CPython"
    if sysconfig.get_config_var("Py_GIL_DISABLED"):
        return "it is a free-threaded build, which the ROS 2 wheels do not support"
    library, number = platform.libc_ver()
    if library != "glibc" or tuple(int(part) for part in number.split(".")[:2]) < GLIBC:
        return (
            "the wheels need glibc " + str(GLIBC[0]) + "." + str(GLIBC[1]) + ", and this is " + library + " " + number
        )
    try:
        import ensurepip
        import venv
    except ImportError as error:
        return "it lacks the module " + str(error.name) + ": apt-get install " + package + "-venv"
    del ensurepip, venv
    if not os.path.exists(os.path.join(sysconfig.get_paths()["include"], "Python.h")):
        return "its header Python.h is missing: apt-get install " + package + "-dev"
    return ""


if __name__ == "__main__":
    reason = fault()
    print(reason or "ok " + platform.python_version() + " " + sys.executable)
    sys.exit(1 if reason else 0)
