"""The program `pipeline`: the nodes `preprocessor` and `detector` in one process.

They are what they are as programs of their own, with the same parameters, services, states and outputs. Only the way
from the one to the other is shorter: the detector gets each prepared cloud as it is, not as a message of its own, and
asks for the next one without a message. The topic `cloud` is published where somebody listens.
"""

from __future__ import annotations

import sys

from regnet_ros.detector import Detector
from regnet_ros.preprocessor import Preprocessor
from regnet_ros.process import Node, run


def nodes() -> list[Node]:
    """Both."""
    preprocessor = Preprocessor()
    return [preprocessor, Detector(preprocessor)]


def main(args: list[str] | None = None) -> int:
    """Run the nodes; the exit code of the process."""
    return run(nodes, args)


if __name__ == "__main__":
    sys.exit(main())
