"""``python -m regnet_core.cli`` is ``regnet``: for launchers, such as torchrun, that start modules."""

import sys

from regnet_core.cli import main

sys.exit(main())
