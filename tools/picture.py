"""Draw the picture of the README: the overview of the report of a seeded ``find`` on the emulated bench, as SVG.

python tools/picture.py docs/result.svg
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

FIND = [
    "find",
    "--json",
    "--quiet",
    "--speed",
    "max",
    "--seed",
    "1",
    "--time",
    "960",
    "--position",
    "50.429,30.523,170",
]


def run(*arguments: str) -> str:
    """Run ``northfinder`` and return what it prints."""
    command = [sys.executable, "-m", "northfinder", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def main() -> None:
    """Measure and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        record = json.loads(run(*FIND, "--out", folder))["record"]
        run("report", record, "--format", "svg", "--output", str(arguments.file))


if __name__ == "__main__":
    main()
