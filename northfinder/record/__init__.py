"""The record of a measurement: one SQLite file that holds everything that was measured, and what was made of it.

`reader` reads it, `recorder` hands what arrives to the thread of `writer`; `schema` is the layout that both go by, and
docs/record.md its description.
"""

from northfinder.record.reader import DwellSpan, Record, StreamInfo

__all__ = ["DwellSpan", "Record", "StreamInfo"]
