"""``python -m northfinder`` is the command line."""

from northfinder.cli import program

program()
