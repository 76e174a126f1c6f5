"""The registers of an Epson sensor: who it is, and the settings of a measurement."""

from __future__ import annotations

from dataclasses import dataclass

from drivers.api import ByteLink, Clock
from drivers.errors import DeviceFaultError, DeviceTimeoutError, ProtocolError
from drivers.protocol import epson

ATTEMPTS = 5
ANSWER_TIMEOUT = 0.2  # s
WRITE_TIME = 0.001  # s between a write and what follows it
QUIET_TIME = 0.1  # s without a byte, after which the stream has ended
NOT_READY_TIME = 3.0  # s, of its start and of its self-test


def check_options(*, sample_rate: float, bits: int, axis: str) -> None:
    """Raise ValueError for what an Epson sensor cannot do, or what is of no use for finding north."""
    if bits == 16:
        raise ValueError(
            "an Epson sensor with numbers of 16 bits finds no north: the earth turns at 0.0042 deg/s, which is "
            "0.6 of the least step of 1/150 deg/s, less still on other models: use bits = 32"
        )
    if bits != 32:
        raise ValueError(f"an Epson sensor sends numbers of 32 bits, not {bits}")
    if sample_rate not in epson.RATE_CODES:
        rates = ", ".join(f"{rate:g}" for rate in sorted(epson.RATE_CODES))
        raise ValueError(f"an Epson sensor sends {rates} samples a second, not {sample_rate:g}")
    if axis not in {"", "x", "y", "z"}:
        raise ValueError(f"the axis of an Epson sensor is x, y or z, not {axis!r}")


@dataclass(frozen=True, slots=True)
class Unit:
    """Who an Epson sensor is."""

    product: str
    serial_number: str
    version: str
    model: epson.Model


class Registers:
    """The registers of a sensor in configuration mode."""

    def __init__(self, link: ByteLink, clock: Clock) -> None:
        self._link = link
        self._clock = clock
        self._window: int | None = None

    def enter_configuration(self) -> None:
        """End sampling, and wait until nothing comes any more.

        Raises
        ------
        ProtocolError
            If bytes go on coming.
        """
        for _ in range(ATTEMPTS):
            self._window = None
            self._link.write(bytes((epson.DELIMITER,)))
            self.write(epson.MODE_CTRL, high=epson.CONFIGURING)
            for _ in range(ATTEMPTS):
                self._clock.sleep_until(self._clock.now() + QUIET_TIME)
                if not self._link.receive():
                    return
        raise ProtocolError(
            f"{self._link.name} goes on sending when told to stop: is it an Epson sensor, at its bit rate?"
        )

    def start_sampling(self) -> None:
        """Enter sampling mode."""
        self.write(epson.MODE_CTRL, high=epson.SAMPLING)

    def stop_sampling(self) -> None:
        """Leave sampling mode; what is on its way still comes."""
        self._window = None
        self.write(epson.MODE_CTRL, high=epson.CONFIGURING)

    def write(self, register: tuple[int, int], *, low: int | None = None, high: int | None = None) -> None:
        """Write one or both bytes of a register."""
        window, address = register
        self._select(window)
        for offset, value in ((0, low), (1, high)):
            if value is not None:
                self._link.write(epson.write_command(address + offset, value))
                self._clock.sleep_until(self._clock.now() + WRITE_TIME)

    def read(self, register: tuple[int, int]) -> int:
        """Return a register's value.

        Raises
        ------
        DeviceTimeoutError
            If nothing answers.
        ProtocolError
            If something else than the register comes.
        """
        window, address = register
        heard = b""
        for _ in range(ATTEMPTS):
            self._select(window)
            self._link.receive()
            self._link.write(epson.read_command(address))
            heard = self._hear(4)
            if len(heard) == 4 and (heard[0], heard[3]) == (address, epson.DELIMITER):
                return int.from_bytes(heard[1:3], "big")
            self._window = None
        if not heard:
            raise DeviceTimeoutError(
                f"{self._link.name} is silent: no Epson sensor has told its register {address:02X}. Look at its "
                "supply, its wires and its bit rate"
            )
        raise ProtocolError(f"{self._link.name} answered {heard[:8].hex(' ')} when asked for register {address:02X}")

    def await_clear(self, register: tuple[int, int], bits: int, doing: str) -> None:
        """Wait until `bits` of a register are 0."""
        deadline = self._clock.now() + NOT_READY_TIME
        while self.read(register) & bits:
            if self._clock.now() >= deadline:
                raise DeviceTimeoutError(f"{self._link.name} has not ended {doing} within {NOT_READY_TIME:g} s")
            self._clock.sleep_until(self._clock.now() + QUIET_TIME / 2)

    def identify(self) -> Unit:
        """Ask who it is.

        Raises
        ------
        ProtocolError
            If it is no Epson sensor, or one whose scales are not known.
        DeviceFaultError
            If it reports a hardware error.
        """
        if (found := self.read(epson.ID)) != epson.ID_VALUE:
            raise ProtocolError(
                f"{self._link.name} is no Epson sensor: its id is {found:04X}, expected {epson.ID_VALUE:04X}"
            )
        self.await_clear(epson.GLOB_CMD, epson.NOT_READY, "starting")
        if errors := self.read(epson.DIAG_STAT) & epson.HARDWARE_ERRORS:
            raise DeviceFaultError(f"{self._link.name} reports a hardware error, {errors:04X} of its DIAG_STAT")
        product = epson.text_of([self.read(register) for register in epson.PROD_ID])
        if product not in epson.MODELS:
            raise ProtocolError(f"{self._link.name} is an Epson {product!r}; known are {', '.join(epson.MODELS)}")
        serial_number = epson.text_of([self.read(register) for register in epson.SERIAL_NUM])
        return Unit(product, serial_number, f"{self.read(epson.VERSION):04X}", epson.MODELS[product])

    def configure(self, sample_rate: float) -> None:
        """Set rate, filter, the burst's fields, numbers of 32 bits, and that it sends by itself; read all back.

        Raises
        ------
        DeviceFaultError
            If a register does not hold what was written, however often.
        """
        for _ in range(ATTEMPTS):  # nothing answers a write: it may have been lost
            refused = self._set_all(sample_rate)
            if not refused:
                return
            self._window = None
        raise DeviceFaultError(f"{self._link.name} does not take its {refused}")

    def _set_all(self, sample_rate: float) -> str:
        """Write all settings once; return what is not as it was written, empty if nothing."""
        rate, smoothing = epson.RATE_CODES[sample_rate], epson.filter_code(sample_rate)
        self.write(epson.SMPL_CTRL, high=rate)
        self.write(epson.FILTER_CTRL, low=smoothing)
        self.await_clear(epson.FILTER_CTRL, epson.FILTER_BUSY, "setting its filter")
        self.write(epson.SIG_CTRL, high=epson.ALL_NEW >> 8)
        self.write(epson.UART_CTRL, low=1)
        self.write(epson.BURST_CTRL1, low=epson.BURST_FIELDS & 0xFF, high=epson.BURST_FIELDS >> 8)
        self.write(epson.BURST_CTRL2, high=epson.BURST_WIDTHS[32])
        for name, register, mask, wanted in (
            ("sample rate", epson.SMPL_CTRL, 0xFF00, rate << 8),
            ("filter", epson.FILTER_CTRL, 0x001F, smoothing),
            ("new-data flags", epson.SIG_CTRL, epson.ALL_NEW, epson.ALL_NEW),
            ("UART mode", epson.UART_CTRL, 0x0003, 1),
            ("burst's fields", epson.BURST_CTRL1, 0xFFFF, epson.BURST_FIELDS),
            ("numbers of 32 bits", epson.BURST_CTRL2, 0x7000, epson.BURST_WIDTHS[32] << 8),
        ):
            found = self.read(register) & mask
            if found != wanted:
                return f"{name}: register {register[1]:02X} holds {found:04X}, {wanted:04X} was written"
        return ""

    def self_test(self) -> tuple[str, ...]:
        """Run the self-test in configuration mode and return what failed.

        Raises
        ------
        DeviceFaultError
            If it does not begin: the results that could be read would be old ones.
        """
        for _ in range(ATTEMPTS):
            self.write(epson.MSC_CTRL, high=epson.SELF_TEST >> 8)
            if self.read(epson.MSC_CTRL) & epson.SELF_TEST:  # it lasts longer than an answer takes
                break
        else:
            raise DeviceFaultError(f"{self._link.name} does not begin its self-test")
        self.await_clear(epson.MSC_CTRL, epson.SELF_TEST, "its self-test")
        found = self.read(epson.DIAG_STAT)
        return tuple(name for bit, name in epson.SELF_TEST_ERRORS.items() if found & bit)

    def _select(self, window: int) -> None:
        """Choose a window; twice, as nothing answers, and in another one the same addresses are other registers."""
        if window != self._window:
            for _ in range(2):
                self._link.write(epson.select_window(window))
                self._clock.sleep_until(self._clock.now() + WRITE_TIME)
            self._window = window

    def _hear(self, size: int) -> bytes:
        """Return up to `size` bytes, or more if they come at once."""
        heard = b""
        deadline = self._clock.now() + ANSWER_TIMEOUT
        while True:
            heard += self._link.receive()
            if len(heard) >= size or self._clock.now() >= deadline:
                return heard
            self._clock.wait(deadline)
