"""What an operator may ask an STIM300 to be set to, and how it is set: in utility mode, and only if told to."""

from __future__ import annotations

from dataclasses import dataclass

from drivers.errors import DeviceError, DeviceFaultError, DeviceTimeoutError
from drivers.frame_stream import FrameStream
from drivers.protocol.stim300 import Configuration, Output
from drivers.protocol.stim300_utility import ENTER, ENTERED, REFUSALS, Reply, encode_command, parse_replies

SAMPLE_RATES = (125, 250, 500, 1000, 2000)  #: Hz, by their codes
OUTPUTS = {"rate": Output.RATE, "increment": Output.INCREMENT, "average": Output.AVERAGE, "integral": Output.INTEGRAL}
_PATIENCE = 1.0  # s


@dataclass(frozen=True, slots=True)
class Settings:
    """What is asked of a unit: it is compared with its configuration, and written to it only with `configure`."""

    sample_rate: int | None = None  #: Hz, None to leave it
    output: Output | None = None  #: of the gyros, None to leave it
    configure: bool = False  #: whether the unit may be set, until it is switched off

    @classmethod
    def gather(cls, *, sample_rate: float | None, output: str, configure: bool) -> Settings:
        """Return the settings of a driver's options; ValueError if they make no sense."""
        if sample_rate is not None and sample_rate not in SAMPLE_RATES:
            raise ValueError(f"an STIM300 samples at {', '.join(map(str, SAMPLE_RATES))} Hz, not at {sample_rate:g} Hz")
        if output and output not in OUTPUTS:
            raise ValueError(f"the output of an STIM300 is one of {', '.join(OUTPUTS)}, not {output!r}")
        rate = None if sample_rate is None else int(sample_rate)
        return cls(sample_rate=rate, output=OUTPUTS[output] if output else None, configure=configure)

    def differs_from(self, found: Configuration) -> bool:
        """Return whether the unit has to be set; raise DeviceFaultError if that is not allowed."""
        if self._difference(found) and not self.configure:
            self.check(found)
        return bool(self._difference(found))

    def check(self, found: Configuration) -> None:
        """Raise DeviceFaultError if the unit is not set to what is asked for."""
        difference = self._difference(found)
        if difference:
            hint = "it did not take the setting" if self.configure else "set it so, or allow that with configure = true"
            raise DeviceFaultError(f"the STIM300 {difference}: {hint}")

    def _difference(self, found: Configuration) -> str:
        if self.sample_rate not in {None, found.sample_rate}:
            now = f"at {found.sample_rate} Hz" if found.sample_rate else "at an external trigger"
            return f"samples {now}, {self.sample_rate} Hz is asked for"
        if self.output not in {None, found.gyro}:
            return f"is set to the gyro output {found.gyro.name.lower()}, {self.output.name.lower()} is asked for"
        return ""


def apply(settings: Settings, stream: FrameStream) -> None:
    """Set the unit, until it is switched off: nothing is saved. It sends no samples meanwhile.

    Raises
    ------
    DeviceTimeoutError
        If it does not answer in utility mode.
    DeviceFaultError
        If it refuses a setting.
    """
    stream.link.write(ENTER)
    _reply(stream, ENTERED)
    try:
        if settings.sample_rate is not None:
            _command(stream, "sm", SAMPLE_RATES.index(settings.sample_rate))
        if settings.output is not None:
            _command(stream, "sgu", settings.output.value)
    except DeviceError:
        stream.link.write(encode_command("xn"))  # whatever happened, it shall not stay silent
        raise
    _command(stream, "xn")


def _command(stream: FrameStream, command: str, *parameters: int) -> None:
    stream.link.write(encode_command(command, *parameters))
    reply = _reply(stream, command)
    if reply.status:
        why = REFUSALS.get(reply.status, f"status {reply.status}")
        asked = ",".join(map(str, (f"${command}", *parameters)))
        raise DeviceFaultError(f"{stream.link.name} refuses {asked}: {why}")


def _reply(stream: FrameStream, command: str) -> Reply:
    """Return the reply to a command, or to one that was not understood."""

    def find(heard: bytes) -> Reply | None:
        return next((reply for reply in parse_replies(heard) if reply.command in {command, ""}), None)

    _, reply = stream.hear(find, patience=_PATIENCE)
    if reply is None:
        raise DeviceTimeoutError(
            f"{stream.link.name} does not answer {command} in utility mode: an older unit has none, "
            "set it in service mode"
        )
    return reply
