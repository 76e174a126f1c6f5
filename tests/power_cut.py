"""What a disk may hold after the power failed: the writes of a traced process, replayed up to any of them.

A write that no fsync has followed is on the disk, or not, or garbled, each sector of 512 bytes for itself (after
https://www.sqlite.org/atomiccommit.html, section 3). A process that is killed loses none of what it wrote.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

SECTOR = 512
TRACED = "trace=openat,pwrite64,write,fsync,fdatasync,ftruncate,unlink"
_CALL = re.compile(r"^(\d+) +(\w+)\((.*)\) += (-?\d+)(?:<([^>]*)>)?")
_STRING = re.compile(r'"((?:\\x[0-9a-f]{2})*)"')


@dataclass(frozen=True)
class Operation:
    """One call that changed a file, or a line that the process said."""

    name: str  #: open, write, sync, truncate, unlink, said
    path: str = ""
    offset: int = 0
    data: bytes = b""


def operations(log: str) -> Iterator[Operation]:
    """Yield what a trace by ``strace -f -y -xx`` holds, in order."""
    begun: dict[str, str] = {}
    for line in log.splitlines():
        pid, _, rest = line.partition(" ")
        if rest.endswith("<unfinished ...>"):
            begun[pid] = line.removesuffix("<unfinished ...>").rstrip()
            continue
        if "resumed>" in rest:
            line = begun.pop(pid) + rest.split("resumed>", 1)[1]  # noqa: PLW2901  # the whole line at last
        call = _CALL.match(line)
        if call is not None and int(call[4]) >= 0:
            yield from _operation(call[2], call[3], call[4], call[5])


def _operation(name: str, arguments: str, returned: str, opened: str | None) -> Iterator[Operation]:
    strings = [bytes.fromhex(text.replace("\\x", "")) for text in _STRING.findall(arguments)]
    path = _path(arguments.partition("<")[2].partition(">")[0])
    numbers = [int(number) for number in re.findall(r", (\d+)", arguments)]
    if name == "openat" and "O_CREAT" in arguments and opened is not None:
        yield Operation("open", _path(opened))
    elif name == "unlink":
        yield Operation("unlink", strings[0].decode())
    elif name == "ftruncate":
        yield Operation("truncate", path, numbers[-1])
    elif name in {"fsync", "fdatasync"}:
        yield Operation("sync", path)
    elif name == "pwrite64":
        yield Operation("write", path, numbers[-1], strings[0][: int(returned)])
    elif name == "write" and strings and strings[0].startswith(b"ack"):
        yield Operation("said", "", int(strings[0].split()[1]))


def _path(text: str) -> str:
    return bytes.fromhex(text.replace("\\x", "")).decode() if text.startswith("\\x") else text


@dataclass
class _File:
    durable: bytes | None = None  #: content at the last sync, None if it was not there
    pending: list[Operation] = field(default_factory=list)

    def keep_names(self) -> None:
        """Take note that the folder was synced: which files there are is on the disk, what is in them need not be."""
        for number, operation in enumerate(self.pending):
            if operation.name in {"open", "unlink"}:
                self.durable = None if operation.name == "unlink" else self.durable or b""
                if operation.name == "unlink":
                    self.pending = self.pending[number + 1 :]
                    self.keep_names()
                    return

    def content(self, rng: np.random.Generator | None) -> bytes | None:
        """Return what the disk holds; without `rng` all that was written, with it whatever may be there."""
        data = None if self.durable is None else bytearray(self.durable)
        for operation in self.pending:
            if operation.name == "open":
                if data is None and (rng is None or rng.random() < 0.8):
                    data = bytearray()
            elif operation.name == "unlink":
                data = None if rng is None or rng.random() < 0.5 else data
            elif data is not None and operation.name == "truncate":
                if rng is None or rng.random() < 0.5:
                    del data[operation.offset :]
                    data.extend(bytes(operation.offset - len(data)))
            elif data is not None:
                _write(data, operation, rng)
        return None if data is None else bytes(data)


def _write(data: bytearray, operation: Operation, rng: np.random.Generator | None) -> None:
    """Write each sector, or not, or garbage."""
    begin, end = operation.offset, operation.offset + len(operation.data)
    while begin < end:
        stop = min(end, (begin // SECTOR + 1) * SECTOR)
        fate = 0.0 if rng is None else rng.random()
        if fate < 0.8:
            data.extend(bytes(max(0, stop - len(data))))
            piece = operation.data[begin - operation.offset : stop - operation.offset]
            data[begin:stop] = piece if fate < 0.4 or rng is None else rng.bytes(stop - begin)
        begin = stop


class Disk:
    """The files of one process, from its trace."""

    def __init__(self, log: str, name: str) -> None:
        """Take the operations on files whose name begins with `name`."""
        found = list(operations(log))
        files = [each.path for each in found if Path(each.path).name.startswith(name)]
        wanted = {*files, *(str(Path(path).parent) for path in files)}
        self.steps = [each for each in found if each.name == "said" or each.path in wanted]

    def cut(self, after: int, folder: Path, rng: np.random.Generator | None) -> int:
        """Write to `folder` what is there after so many operations; return how much the process had acknowledged."""
        files: dict[str, _File] = {}
        folders = {str(Path(step.path).parent) for step in self.steps if step.path and step.name != "sync"}
        acknowledged = 0
        for operation in self.steps[:after]:
            if operation.name == "said":
                acknowledged = operation.offset
                continue
            if operation.path in folders:
                for file in files.values():
                    file.keep_names()
                continue
            file = files.setdefault(Path(operation.path).name, _File())
            if operation.name == "sync":
                file.durable, file.pending = file.content(None), []
            else:
                file.pending.append(operation)
        for name, file in files.items():
            content = file.content(rng)
            if content is not None and not name.endswith("-shm"):
                (folder / name).write_bytes(content)
        return acknowledged
