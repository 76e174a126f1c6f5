"""Lets tests import the scripts of ``tools``, and gives property tests all the time they need on a busy machine."""

import sys
from pathlib import Path

from hypothesis import settings

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools"))

settings.register_profile("patient", deadline=None)
settings.load_profile("patient")
