"""Who writes a record holds a lock on it, which the system gives back whatever happens to the process."""

from __future__ import annotations

import os
from pathlib import Path

from northfinder.errors import RecordError

try:
    import fcntl
except ImportError:  # no such locks there: two writers are then kept apart by SQLite's own alone
    fcntl = None  # type: ignore[assignment]  # tested for


class RecordLock:
    """A lock on an existing file. SQLite's own locks are of another sort and know nothing of it."""

    def __init__(self, path: Path) -> None:
        """Take the lock. Raises RecordError if another process has it."""
        self._file: int | None = None
        try:
            self._file = _locked(path, shared=False)
        except BlockingIOError:
            raise RecordError(f"the record {path} is being written by another process") from None
        except OSError as error:
            raise RecordError(f"the record {path} cannot be opened: {error.strerror}") from None

    def release(self) -> None:
        """Give the lock back. Only once the database is closed: SQLite loses its locks with any handle on the file."""
        if self._file is not None:
            os.close(self._file)
            self._file = None


def is_being_written(path: Path) -> bool:
    """Return whether a process holds the record's lock; False if that cannot be told."""
    try:
        file = _locked(path, shared=True)  # two who ask at once are no writer to each other
    except OSError as error:
        return isinstance(error, BlockingIOError)
    if file is not None:
        os.close(file)
    return False


def _locked(path: Path, *, shared: bool) -> int | None:
    """Return a handle that holds the lock, None where there are no locks. Raises BlockingIOError if it is taken."""
    if fcntl is None:
        return None
    file = os.open(path, os.O_RDONLY | os.O_NONBLOCK)  # a pipe is not waited for
    try:
        fcntl.flock(file, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except OSError:
        os.close(file)
        raise
    return file
