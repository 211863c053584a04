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
from regnet_ros.settings import DetectorParameters, PreprocessorParameters


def nodes() -> list[Node]:
    """Both."""
    preprocessor = Preprocessor(beside=[DetectorParameters])
    return [preprocessor, Detector(preprocessor, beside=[PreprocessorParameters])]


def main(args: list[str] | None = None) -> int:
    """Run the nodes; the exit code of the process."""
    return run(nodes, args)


if __name__ == "__main__":
    sys.exit(main())
