"""Serve an emulated bench: ``python -m sim_device --help``."""

from __future__ import annotations

import sys

from sim_device.server import main

if __name__ == "__main__":
    sys.exit(main())
