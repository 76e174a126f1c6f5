"""The emulated bench in a child process, for `find` without hardware."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import dataclass
from types import TracebackType
from typing import Self

from drivers.errors import LinkError
from northfinder.cli import EXIT_USAGE
from northfinder.errors import ConfigError


@dataclass(frozen=True, slots=True, kw_only=True)
class SimulationOptions:
    """What the emulated world is like; angles in deg."""

    azimuth_deg: float
    latitude_deg: float
    profile: str
    seed: int
    speed: str
    gyro: str = "native"  #: which instruments, see `sim_device.instruments`
    stage: str = "native"
    only: str = ""  #: "gyro" for one without a stage
    bus: str = ""  #: "socketcand" or "slcan" for a CAN bus, serial lines if empty


class EmulatorProcess:
    """The emulator as a child process; it ends with its parent, whatever happens to the parent."""

    def __init__(self, options: SimulationOptions) -> None:
        """Start the child; `announcement` then waits for its addresses."""
        self._child = subprocess.Popen(  # noqa: S603  # our own module, arguments made by us
            [
                sys.executable, "-m", "sim_device", "--parent-death",
                "--azimuth", repr(options.azimuth_deg), "--latitude", repr(options.latitude_deg),
                "--gyro", options.gyro, "--stage", options.stage,
                "--profile", options.profile, "--seed", str(options.seed), "--speed", options.speed,
                *(("--only", options.only) if options.only else ()),
                *(("--bus", options.bus) if options.bus else ()),
            ],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            # A Ctrl-C is for the host to act on: the emulated stage must be there to be stopped.
            start_new_session=True,
        )  # fmt: skip

    def announcement(self) -> dict[str, str]:
        """Return what the child says of itself: its addresses under ``gyro`` and ``stage``. Raises LinkError."""
        assert self._child.stdout is not None  # noqa: S101  # opened as a pipe above
        assert self._child.stderr is not None  # noqa: S101
        line = self._child.stdout.readline()
        if not line:
            reason = self._child.stderr.read().decode(errors="replace").strip().splitlines()
            sentence = f"the emulator did not start: {reason[-1] if reason else 'it said nothing'}"
            raise ConfigError(sentence) if self._child.wait() == EXIT_USAGE else LinkError(sentence)
        announcement: dict[str, str] = json.loads(line)
        return announcement

    def __enter__(self) -> Self:
        """Return the process itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """End the child at once: it has nothing to put in order."""
        self._child.kill()
        self._child.wait()
        for pipe in (self._child.stdin, self._child.stdout, self._child.stderr):
            if pipe is not None:
                pipe.close()
