"""What can go wrong on the instrument's own side.

    NorthFinderError
     +-- ConfigError      a configuration, plan, profile or option cannot be used
     +-- RecordError      a record or data file cannot be read or written
     +-- SequenceError    the sequencer met an event its table does not hold: a bug of ours
     +-- EstimateError    the data do not determine what was asked; the message names the reason

Devices fail with the exceptions of ``drivers.errors``. The command line turns both trees into one line and an exit
code; nothing else catches them.
"""

from __future__ import annotations


class NorthFinderError(Exception):
    """The instrument cannot do what was asked."""


class ConfigError(NorthFinderError):
    """A configuration, plan, profile or option cannot be used."""


class RecordError(NorthFinderError):
    """A record or data file cannot be read or written."""


class SequenceError(NorthFinderError):
    """The sequencer met an event that its table does not hold: a bug of ours."""


class EstimateError(NorthFinderError):
    """The data do not determine what was asked."""
