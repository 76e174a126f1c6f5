"""Records for other programs: samples with everything measured beside them, units in the names, nothing rounded."""

from __future__ import annotations

from northfinder.export.formats import FORMATS, export_record

__all__ = ["FORMATS", "export_record"]
