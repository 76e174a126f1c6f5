"""Files that operators name: one to read, and a new one that is there whole or not at all."""

from __future__ import annotations

import os
import secrets
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from northfinder.errors import RecordError


def require_file(path: Path) -> None:
    """Raise RecordError unless `path` is a plain file: a pipe or a device may never end, or never begin."""
    try:
        mode = path.stat().st_mode
    except OSError as error:
        left = "; its log is there: northfinder recover saves what that holds" if has_log(path) else ""
        raise RecordError(f"{path}: cannot be read: {error.strerror}{left}") from None
    if not stat.S_ISREG(mode):
        found = "a folder" if stat.S_ISDIR(mode) else "a pipe or a device"
        raise RecordError(f"{path}: cannot be read: found {found}, expected a file")


def require_database(path: Path) -> None:
    """Raise RecordError unless `path`, and all that SQLite would open with it, are plain files."""
    require_file(path)
    for beside in (f"{os.path.realpath(path)}{ending}" for ending in ("-journal", "-wal", "-shm")):
        if os.path.lexists(beside) and not os.path.isfile(beside):  # noqa: PTH113  # as below
            raise RecordError(f"{path}: cannot be read: found {Path(beside).name}, expected a file there or nothing")


def log_of(path: Path) -> Path:
    """Return where SQLite keeps the log of the record `path`: beside the file itself, not beside a link to it."""
    return Path(f"{os.path.realpath(path)}-wal")


def has_log(path: Path) -> bool:
    """Return whether there is a log beside the record `path`."""
    return os.path.isfile(log_of(path))  # noqa: PTH113  # Path.is_file raises where a name is too long


@contextmanager
def new_file(out: Path) -> Iterator[Path]:
    """Yield where to write what shall be `out`: it gets that name once it is whole, and is gone if it never is.

    Raises RecordError if `out` exists, or for any OSError meanwhile.
    """
    if os.path.lexists(out):
        raise RecordError(f"{out} exists already: nothing is overwritten")
    make_folder(out.parent)
    folder = out.parent / f"northfinder-{secrets.token_hex(8)}"
    try:
        folder.mkdir(
            mode=0o700
        )  # named before it is made: whenever the program is interrupted, it is known what to remove
        yield folder / out.name
        (folder / out.name).rename(out)
        sync_folder(out.parent)
    except OSError as error:
        raise RecordError(f"{out} cannot be written: {error.strerror or error}") from None
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def make_folder(folder: Path) -> None:
    """Make a folder where there is none. Raises RecordError."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecordError(f"the folder {folder} cannot be made: {error.strerror}") from None


def sync_folder(folder: Path) -> None:
    """Make a new name in `folder` durable, where the system can."""
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
