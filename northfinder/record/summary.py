"""What a record says of itself on a line, for a list of records, and on a page."""

from __future__ import annotations

from collections import Counter
from contextlib import suppress
from pathlib import Path
from typing import Any

from northfinder.errors import RecordError
from northfinder.record import Record
from northfinder.record.facts import completeness
from northfinder.record.lock import is_being_written

#: A folder with more records than this is listed by its newest ones.
MAX_LISTED = 10_000


def list_records(folder: Path) -> list[dict[str, Any]]:
    """Return a line for each record in `folder`, the newest first. Raises RecordError if the folder cannot be read."""
    try:
        found = sorted((path for path in folder.iterdir() if path.suffix == ".sqlite"), reverse=True)
    except OSError as error:
        raise RecordError(f"{folder}: cannot be read: {error.strerror}, expected a folder with records") from None
    return [summary(path) for path in found[:MAX_LISTED]]


def newest_record(folder: Path) -> Path:
    """Return the record in `folder` that was begun last. Raises RecordError if there is none."""
    listed = list_records(folder)
    records = [line for line in listed if line["state"] != "damaged"]
    if not records:
        raise RecordError(f"no record in {folder}: expected a file north-….sqlite")
    return Path(max(records, key=lambda line: (line["started_utc_s"] or 0.0, line["record"]))["record"])


def summary(path: Path) -> dict[str, Any]:
    """Return one record on a line: state, when, what, and its fix; of a damaged one that it is damaged, and how."""
    written = is_being_written(path)  # before the database is opened: SQLite would lose its locks
    line: dict[str, Any] = {
        "record": str(path), "state": "damaged", "started_utc_s": None, "plan": None, "steps": None, "gyro": None,
        "azimuth_deg": None, "azimuth_sd_deg": None, "latitude_deg": None, "latitude_sd_deg": None, "trustworthy": None,
        "n_notes": 0,
        "size_bytes": 0, "problem": None,
    }  # fmt: skip
    with suppress(OSError):
        line["size_bytes"] = path.stat().st_size
    try:
        with Record(path) as record:
            return line | _facts(record, written=written)
    except RecordError as error:
        return line | {"problem": str(error)}


def _facts(record: Record, *, written: bool) -> dict[str, Any]:
    events, fixes = record.events(), record.fixes()
    fix = fixes[-1] if fixes and isinstance(fixes[-1], dict) else {}
    names = ("azimuth_deg", "azimuth_sd_deg", "latitude_deg", "latitude_sd_deg")
    gyro = _entries(_entries(record.meta("identities")).get("gyro"))
    state = "being written" if written else "complete" if fixes else "ends early"
    return {
        "state": state,
        "started_utc_s": events[0][0] if events else None,
        "plan": _entries(record.meta("plan")).get("name"),
        "steps": completeness(record)["steps"],
        "gyro": f"{gyro.get('model', '')} {gyro.get('serial_number', '')}".strip() or None,
        "trustworthy": _is_trustworthy(fix),
        "n_notes": len(record.notes()),
    } | {name: fix.get(name) for name in names}


def _is_trustworthy(fix: dict[str, Any]) -> bool | None:
    """Return whether all decisive checks of a fix have passed, None if there are none."""
    checks = fix.get("checks")
    decisive = [each for each in map(_entries, checks if isinstance(checks, list) else []) if each.get("decisive")]
    return all(each.get("passed") is True for each in decisive) if decisive else None


def _entries(value: Any) -> dict[str, Any]:  # noqa: ANN401  # whatever the record holds
    """Return `value` if it has entries by name."""
    return value if isinstance(value, dict) else {}


def page(path: Path) -> dict[str, Any]:
    """Return all of a record but its samples. Raises RecordError."""
    written = is_being_written(path)
    with Record(path) as record:
        facts = _facts(record, written=written)
        keys = dict.fromkeys(row[1] for row in record.rows("meta"))
        return facts | {
            "record": str(path),
            "meta": {key: record.meta(key) for key in keys},
            "streams": record.streams(),
            "step_list": record.steps(),
            "events": [{"utc_s": time, "kind": kind, "detail": detail} for time, kind, detail in record.events()],
            "n_blocks": record.count("block"),
            "n_stage_states": record.count("stage_state"),
            "fixes": record.fixes(),
            "event_counts": dict(Counter(kind for _, kind, _ in record.events())),
        }
