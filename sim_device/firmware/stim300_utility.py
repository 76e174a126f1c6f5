"""Utility mode of the STIM300: commands in text with a CRC-8."""


def crc8(text: bytes) -> int:
    """Return the checksum: polynomial 07, from FF, highest bit first."""
    crc = 0xFF
    for byte in text:
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ 0x07) & 0xFF if crc & 0x80 else crc << 1
    return crc


def _line(text: str) -> bytes:
    body = text.encode()
    return body + str(crc8(body)).encode() + b"\r"


class UtilityMode:
    """A visit to utility mode.

    Parameters
    ----------
    unit : Stim300Device
        What is set.
    serial_number : str
        As it is told.
    """

    def __init__(self, unit, serial_number: str) -> None:  # type: ignore[no-untyped-def]  # noqa: ANN001  # either would import the other
        self._unit = unit
        self._serial_number = serial_number
        self.left = False  # whether the host has asked for normal mode

    def greeting(self) -> bytes:
        """Return what is said on entering."""
        return _line("#UTILITYMODE,")

    def answer(self, line: bytes) -> bytes:
        """Return the reply to a command."""
        comma = line.rfind(b",")
        body, given = line[: comma + 1], line[comma + 1 :]
        if not line.startswith(b"$") or comma < 0 or any(not 32 <= byte < 127 for byte in line):
            return _line("#,1,")
        if not given.isdigit() or int(given) != crc8(body):
            return _line("#,2,")
        parts = body[1:-1].decode().split(",")
        return _line("#%s," % ",".join(self._execute(parts[0], parts[1:])))

    def _execute(self, command: str, parameters: "list[str]") -> "list[str]":
        """Return the parts of the reply."""
        if command == "isn" and not parameters:
            return [command, "0", self._serial_number]
        if command == "xn" and not parameters:
            self.left = True
            return [command, "0"]
        if command not in ("sm", "sgu"):
            return ["", "3"]
        if len(parameters) != 1:
            return [command, "4"]
        if not parameters[0].isdigit():
            return [command, "5"]
        value = int(parameters[0])
        if command == "sm" and not self._unit.set_sample_rate(value):
            return [command, "5"]
        if command == "sgu":
            if value > 3:
                return [command, "5"]
            self._unit.output = value
        return [command, "0", parameters[0]]
