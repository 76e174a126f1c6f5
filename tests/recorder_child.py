"""A process that records, for tests that kill it or take its disk away: ``recorder_child.py FILE N_BLOCKS [BYTES]``.

It says ``ack K`` once K blocks are durable; BYTES limits the size of its files. ``recorder_child.py -`` forks one such
process, without end, for each file named on standard input; it says ``pid N`` first and ``gone`` when that has died.
"""

import os
import resource
import sys
from pathlib import Path

from recording import block, fill

from northfinder.errors import RecordError
from northfinder.record.recorder import Recorder


def main(path: Path, n_blocks: int) -> int:
    """Record blocks one after the other, each made durable; return the exit code."""
    try:
        with Recorder(path, lambda: 1.0) as recorder:
            recorder._writer.checkpoint_commits = 4
            fill(recorder, 0)
            recorder.flush()
            block(0)  # whatever it takes is imported by now
            for k in range(n_blocks):
                recorder.add_block(block(39 * k))
                recorder.flush()
                os.write(1, f"ack {k + 1}\n".encode())
    except RecordError as error:
        os.write(2, f"{error}\n".encode())
        return 5
    return 0


def serve() -> None:
    """Fork a process for each file; a fork costs a thousandth of what a new interpreter takes to import all."""
    for line in sys.stdin:
        pid = os.fork()
        if not pid:
            os.write(1, f"pid {os.getpid()}\n".encode())
            os._exit(main(Path(line.rstrip("\n")), sys.maxsize))
        os.waitpid(pid, 0)
        os.write(1, b"gone\n")


if __name__ == "__main__":
    if sys.argv[1] == "-":
        serve()
        sys.exit()
    if len(sys.argv) > 3:
        resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[3]), int(sys.argv[3])))
    sys.exit(main(Path(sys.argv[1]), int(sys.argv[2])))
