"""The command line: parse, compose, show, exit code. Only here (and in tests and tools) a driver meets an emulator.

A command's module is imported only when that command runs, so that ``northfinder --help`` is quick.
"""

from __future__ import annotations

import importlib
import math
import os
import select
import signal
import sys
import threading
from contextlib import suppress
from types import FrameType
from typing import NoReturn

import click

#: Exit codes, documented in docs/operators-guide.md.
EXIT_USAGE = 2
EXIT_DEVICE = 3
EXIT_ESTIMATE = 4
EXIT_RECORD = 5
EXIT_FINDING = 6
EXIT_INTERRUPTED = 130

_COMMANDS = {
    "find": "Measure the true azimuth and the latitude.",
    "resume": "Go on with a measurement that was interrupted.",
    "plan": "Predict what each plan gives in a given time.",
    "budget": "Predict what a fix will owe its uncertainty to.",
    "solve": "Estimate again from a record, or from a table of measurements.",
    "records": "List the records in a folder.",
    "show": "Show what a record holds.",
    "note": "Add an operator's note to a record.",
    "check": "Check that a record is sound.",
    "recover": "Save what is left of a damaged record.",
    "export": "Write a record's samples as CSV, Parquet, NPZ or MAT.",
    "report": "Write a record, or a campaign, as a page, a picture or data.",
    "stats": "Show what a campaign of measurements says of the instrument.",
    "calibrate": "Find an instrument's constants where the truth is known.",
    "allan": "Identify a gyro's noise from a recording at rest.",
    "emulate": "Serve an emulated gyro and stage.",
    "devices": "List the ports and identify what answers.",
    "doctor": "Check a bench and say in words what is wrong.",
}


#: Name of the thread that shows how a measurement goes on.
DISPLAY_THREAD = "display"
#: Commands whose module is not named as they are.
_MODULES = {"show": "show_record"}


def _finite(context: click.Context, parameter: click.Parameter, value: object) -> object:
    """Refuse numbers that are infinite or none: click takes them for numbers, also within a range."""
    values = value if isinstance(value, tuple) else (value,)
    if any(isinstance(each, float) and not math.isfinite(each) for each in values):
        raise click.BadParameter("expected a finite number", context, parameter)
    return value


class _LazyGroup(click.Group):
    """Commands by name, imported when called for."""

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002  # click's signature
        """Return the commands in the order an operator meets them."""
        return list(_COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:  # noqa: ARG002
        """Import the command."""
        if cmd_name not in _COMMANDS:
            return None
        module = importlib.import_module(f"northfinder.cli.{_MODULES.get(cmd_name, cmd_name)}")
        interruption.begun = True
        command: click.Command = module.command
        for parameter in command.params:
            if isinstance(parameter.type, click.types.FloatParamType):
                parameter.callback = _finite
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002
        """List the commands without importing them."""
        with formatter.section("Commands"):
            formatter.write_dl(list(_COMMANDS.items()))


@click.group(
    cls=_LazyGroup,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
    epilog="Exit codes: 0 done, 2 usage or configuration, 3 device or link, 4 no trustworthy estimate, "
    "5 record or file, 6 a check of doctor has failed, 130 interrupted.",
)
@click.version_option(package_name="northfinder")
def cli() -> None:
    """Find true north and the latitude with a vibratory gyro on a rotation stage.

    \b
    Try it without any hardware:
      northfinder find --speed max
    """  # noqa: D301  # \b is click's mark to keep these lines as they are


class _Interrupted(BaseException):
    """A signal to end. No KeyboardInterrupt: click would say so first, to streams that perhaps nobody reads."""


class _Interruption:
    """What the handler of signals knows and leaves; no `threading.Event`, whose lock a second signal would wait for."""

    #: Whether a command has been imported. Before, nothing is open, and what is raised may be swallowed: Python calls
    #: back while it imports, and ignores what comes of that.
    begun = False
    #: Whether a signal to end has come since, in case what it raised was swallowed all the same.
    has_come = False


interruption = _Interruption()


def program() -> NoReturn:
    """Run the process's own command line, until it is done or a signal tells it to end."""
    signals = ending_signals()

    def interrupt(number: int, frame: FrameType | None) -> NoReturn:  # noqa: ARG001  # the signal module's signature
        if not interruption.begun:
            _leave_interrupted(signals)
        interruption.has_come = True
        raise _Interrupted

    for number in signals:
        signal.signal(number, interrupt)
    try:
        main()
    except _Interrupted:  # all is in order again
        _leave_interrupted(signals)
    finally:
        _ignore(signals)  # it is too late for another exit code


def _leave_interrupted(signals: list[signal.Signals]) -> NoReturn:
    """Leave at once; what else was still to be said may have nobody to read it."""
    _ignore(signals)
    with suppress(OSError, ValueError):
        if select.select([], [sys.stderr], [], 0.0)[1]:
            os.write(sys.stderr.fileno(), b"northfinder: interrupted\n")
    os._exit(EXIT_INTERRUPTED)


def _ignore(signals: list[signal.Signals]) -> None:
    for number in signals:
        signal.signal(number, signal.SIG_IGN)


def main(arguments: list[str] | None = None) -> NoReturn:
    """Run a command line, by default the process's own, and leave with its exit code; every failure is one line."""
    from drivers.errors import DeviceError  # noqa: PLC0415  # keeps --help quick
    from northfinder.errors import NorthFinderError  # noqa: PLC0415
    from northfinder.text import printable  # noqa: PLC0415

    try:
        code = cli.main(arguments, standalone_mode=False)
    except click.exceptions.Abort:
        _complain("northfinder: interrupted")
        code = EXIT_INTERRUPTED
    except click.ClickException as error:
        error.show()
        code = error.exit_code
    except (DeviceError, NorthFinderError) as error:
        _complain(f"northfinder: {printable(str(error), max_length=1000)}")
        code = exit_code(error)
    except BrokenPipeError:
        # Whoever read our output has gone; nothing is left to say to them.
        sys.stderr.close()
        code = 1
    _leave(code if isinstance(code, int) else 0)


def ending_signals() -> list[signal.Signals]:
    """Return the signals to end by: a hang-up is none if whoever started the program wants it ignored, as nohup does.

    A shell lets what it starts in the background ignore Ctrl-C, but who presses it wants the stage to stop.
    """
    ignored = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN if hasattr(signal, "SIGHUP") else True
    return [signal.SIGINT, signal.SIGTERM, *([] if ignored else [signal.SIGHUP])]


def _display_is_stuck() -> bool:
    """Return whether whoever should read what a measurement shows has stopped reading."""
    return any(thread.name == DISPLAY_THREAD for thread in threading.enumerate())


def _complain(line: str) -> None:
    """Print the one line of a failure, if anybody is there to read it."""
    if not _display_is_stuck():
        with suppress(OSError):
            print(line, file=sys.stderr, flush=True)  # noqa: T201  # the one line


def _leave(code: int) -> NoReturn:
    """Leave with `code`, whatever has become of the terminal."""
    if _display_is_stuck():  # it holds the lock of a stream that Python would wait for
        os._exit(code)
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, ValueError):  # nobody reads any more, and nothing is left to say
            with suppress(OSError, ValueError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
    sys.exit(code)


def exit_code(error: Exception) -> int:
    """Return the documented exit code of a declared failure."""
    from drivers.errors import DeviceError  # noqa: PLC0415
    from northfinder.errors import ConfigError, EstimateError, RecordError  # noqa: PLC0415
    from northfinder.sequencer import StopRequestedError  # noqa: PLC0415

    table: list[tuple[type[Exception], int]] = [
        (ConfigError, EXIT_USAGE),
        (DeviceError, EXIT_DEVICE),
        (EstimateError, EXIT_ESTIMATE),
        (RecordError, EXIT_RECORD),
        (StopRequestedError, EXIT_INTERRUPTED),
    ]
    return next((code for kind, code in table if isinstance(error, kind)), 1)
