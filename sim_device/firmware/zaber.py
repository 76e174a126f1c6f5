r"""A two-axis controller that speaks the Zaber ASCII protocol, as a function of time. See ``docs/zaber.md``.

It answers what clients ask of such a controller when they connect, home, move, stop and look at settings. Whatever else
is asked it rejects with BADCOMMAND, as a controller of another firmware would. No watchdog: like the real one it ends a
motion that was begun, whether the host is still there or not.
"""

from sim_device.firmware.hardware import StageBoard
from sim_device.firmware.zaber_axis import ORDER, ZaberAxis

ADDRESS = 1
DEVICE_ID = 65001  # of no controller that can be bought
VERSION = "7.35"
_MAX_LINE = 128
_REST_CHECK_US = 100_000
_NUMBER_DIGITS = 12


def checksum(text: bytes) -> int:
    """Return what brings the sum of the bytes to 0 modulo 256."""
    return -sum(text) & 0xFF


def _number(word: str) -> "int | None":
    """Return a decimal number, None if it is none."""
    digits = word[1:] if word[:1] == "-" else word
    if not digits or len(digits) > _NUMBER_DIGITS or any(digit not in "0123456789" for digit in digits):
        return None
    return int(word)


def _verified(line: bytes) -> "bytes | None":
    """Return a line without its checksum, None if that is wrong."""
    if len(line) < 4 or line[-3:-2] != b":":
        return line
    try:
        told = int(line[-2:].decode(), 16)
    except ValueError:
        return None
    return line[:-3] if told == checksum(line[1:-3]) else None


class ZaberDevice:
    """The controller on its line.

    Attributes
    ----------
    session : int
        1 once a host has said something.
    seen_time_us : int
        When it last did.

    Parameters
    ----------
    board : StageBoard
        The hardware, or its emulation.
    """

    told_time_us = -1
    testing = False

    def __init__(self, board: StageBoard) -> None:
        self.session = 0
        self.seen_time_us = 0
        self._board = board
        self._axes = [ZaberAxis(board, 0), ZaberAxis(board, 1)]
        self._line = b""
        self._overlong = False
        self._out = b""
        self._tick_due_us = 0
        self._settings = {"comm.checksum": 0, "comm.alert": 0}

    # the line

    def feed(self, data: bytes, now_us: int) -> None:
        """Take bytes that have arrived, and act on the lines they complete."""
        self.session = 1
        self.seen_time_us = now_us
        for index in range(len(data)):
            byte = data[index : index + 1]
            if byte in (b"\r", b"\n"):
                if not self._overlong:
                    self._read(self._line, now_us)
                self._line, self._overlong = b"", False
            elif len(self._line) < _MAX_LINE:
                self._line += byte
            else:
                self._overlong = True

    def poll(self, now_us: int, _room: "int | None" = None) -> bytes:
        """Do what is due and return the bytes to send."""
        while self._tick_due_us <= now_us:
            self._tick(self._tick_due_us)
        out, self._out = self._out, b""
        return out

    def next_due_us(self) -> int:
        """Return when `poll` will have something to do."""
        return self._tick_due_us

    def _tick(self, now_us: int) -> None:
        for number, axis in enumerate(self._axes):
            was_busy = axis.busy
            axis.tick(now_us)
            if was_busy and not axis.busy and self._settings["comm.alert"]:
                self._send("!%02d %d %s" % (ADDRESS, number + 1, self._status([axis])))
        busy = any(axis.busy for axis in self._axes)
        self._tick_due_us = now_us + (self._board.control_period_us if busy else _REST_CHECK_US)

    def _send(self, text: str) -> None:
        if self._settings["comm.checksum"]:
            text += ":%02X" % checksum(text[1:].encode())
        self._out += text.encode() + b"\r\n"

    @staticmethod
    def _status(axes: list) -> str:  # type: ignore[type-arg]  # MicroPython has no list[ZaberAxis]
        """Return status and gravest warning of some axes."""
        flags = [flag for axis in axes for flag in axis.flags]
        gravest = [flag for flag in ORDER if flag in flags]
        return "%s %s" % ("BUSY" if any(axis.busy for axis in axes) else "IDLE", gravest[0] if gravest else "--")

    def _read(self, line: bytes, now_us: int) -> None:
        """Act on a line and answer it; what is damaged or for another device gets no answer."""
        start = line.find(b"/")
        body = _verified(line[start:]) if start >= 0 else None
        if body is None or any(not 0x20 <= byte < 0x7F for byte in body):
            return
        words = body[1:].decode().split()
        numbers: list[int] = []
        while words and len(numbers) < 3 and _number(words[0]) is not None:
            numbers.append(int(words.pop(0)))
        numbers += [0, 0][: max(0, 2 - len(numbers))]
        device, number = numbers[:2]
        if device not in (0, ADDRESS):
            return
        message = ""
        if len(numbers) == 3:
            if not 0 <= numbers[2] <= 99:
                self._answer(number, "", "RJ", "BADMESSAGEID")
                return
            message = " %02d" % numbers[2]
        if not 0 <= number <= len(self._axes):
            self._answer(min(max(number, 0), 9), message, "RJ", "BADAXIS")
            return
        if not any(axis.busy for axis in self._axes):
            self._tick_due_us = now_us  # whatever is begun now
        refusal, data = self._execute(number, words, now_us)
        self._answer(number, message, "RJ" if refusal else "OK", refusal or data)

    def _answer(self, number: int, message: str, flag: str, data: str) -> None:
        status = self._status(self._chosen(number))
        self._send("@%02d %d%s %s %s %s" % (ADDRESS, number, message, flag, status, data))

    def _chosen(self, number: int) -> list:  # type: ignore[type-arg]  # as _status
        return [self._axes[number - 1]] if 1 <= number <= len(self._axes) else self._axes

    # commands: each returns (why it is rejected, "" if it is not; the data of the answer)

    def _execute(self, number: int, words: list, now_us: int) -> "tuple[str, str]":  # type: ignore[type-arg]  # as _status
        if not words:
            return "", "0"
        name, values = words[0], words[1:]
        if name == "get" and len(values) == 1:
            return self._get(number, values[0], now_us)
        if name == "set" and len(values) == 2:
            return self._set(number, values[0], values[1])
        if name == "warnings" and values in ([], ["clear"]):
            return self._warnings(number, values)
        if name == "driver" and values in (["enable"], ["disable"]):
            wanted = values == ["enable"]
            done = [axis.switch(now_us, enabled=wanted) for axis in self._chosen(number)]
            return ("", "0") if all(done) else ("AGAIN", "")
        if name in ("stop", "estop") and not values:
            for axis in self._chosen(number):
                axis.stop(now_us)
            return "", "0"
        if name == "home" and not values:
            return self._home(number, now_us)
        if name == "move" and values:
            return self._move(number, values, now_us)
        return "BADCOMMAND", ""

    def _get(self, number: int, name: str, now_us: int) -> "tuple[str, str]":
        axes = self._chosen(number)
        if name in axes[0].settings:
            return "", " ".join([str(axis.settings[name]) for axis in axes])
        if name == "pos":
            return "", " ".join([str(axis.position(now_us)) for axis in axes])
        if name == "driver.enabled":
            return "", " ".join([str(int(not axis.disabled)) for axis in axes])
        facts = {
            "deviceid": str(DEVICE_ID),
            "device.id": str(DEVICE_ID),
            "version": VERSION,
            "system.serial": str(self._serial_number()),
            "system.axiscount": str(len(self._axes)),
            "comm.address": str(ADDRESS),
        }
        if name not in facts and name not in self._settings:
            return "BADCOMMAND", ""
        if number:
            return "DEVICEONLY", ""
        return "", facts[name] if name in facts else str(self._settings[name])

    def _serial_number(self) -> int:
        digits = "".join([letter for letter in self._board.serial_number if letter in "0123456789"])
        return int(digits or "0")

    def _set(self, number: int, name: str, text: str) -> "tuple[str, str]":
        value = _number(text)
        if name in self._settings:
            if number:
                return "DEVICEONLY", ""
            if value not in (0, 1):
                return "BADDATA", ""
            self._settings[name] = value
            return "", "0"
        axes = self._chosen(number)
        if name not in axes[0].settings:
            return "BADCOMMAND", ""
        if value is None or not all(axis.allowed(name, value) for axis in axes):
            return "BADDATA", ""
        for axis in axes:
            axis.settings[name] = value
        return "", "0"

    def _warnings(self, number: int, values: list) -> "tuple[str, str]":  # type: ignore[type-arg]  # as _status
        axes = self._chosen(number)
        found = [flag for axis in axes for flag in axis.flags]
        flags = [flag for flag in ORDER if flag in found]
        if values:
            for axis in axes:
                axis.clear()
        return "", "%02d%s" % (len(flags), "".join([" " + flag for flag in flags]))

    def _home(self, number: int, now_us: int) -> "tuple[str, str]":
        axes = self._chosen(number)
        if any(axis.disabled for axis in axes):
            return "DRIVERDISABLED", ""
        for axis in axes:
            axis.home(now_us)
        return "", "0"

    def _move(self, number: int, values: list, now_us: int) -> "tuple[str, str]":  # type: ignore[type-arg]  # as _status
        axes = self._chosen(number)
        kind, numbers = values[0], [_number(word) for word in values[1:]]
        n_least = {"abs": 1, "rel": 1, "vel": 1, "min": 0, "max": 0}.get(kind)
        if n_least is None:
            return "BADCOMMAND", ""
        if None in numbers or not n_least <= len(numbers) <= n_least + (kind != "vel"):
            return "BADDATA", ""
        if any(axis.disabled for axis in axes):
            return "DRIVERDISABLED", ""
        plans = [_plan(axis, kind, numbers, now_us) for axis in axes]
        if () in plans:
            return "BADDATA", ""
        for axis, plan in zip(axes, plans):
            axis.move(plan[0], plan[1], now_us)
        return "", "0"


def _plan(axis: ZaberAxis, kind: str, numbers: list, now_us: int) -> "tuple[int, ...]":  # type: ignore[type-arg]  # as above
    """Return target and speed of a move, nothing if the axis cannot do it: without a reference only `rel`, `vel`."""
    settings = axis.settings
    speed = settings["maxspeed"]
    here = axis.position(now_us)
    if kind == "vel":
        speed = abs(numbers[0])
        target = settings["limit.max"] if numbers[0] > 0 else settings["limit.min"]
        if not speed:
            target, speed = here, 1
    else:
        target = {"min": settings["limit.min"], "max": settings["limit.max"]}.get(kind, numbers[0] if numbers else 0)
        target += here if kind == "rel" else 0
        speed = numbers[-1] if len(numbers) > (kind in ("abs", "rel")) else speed
    if not (1 <= speed <= settings["maxspeed"] and settings["limit.min"] <= target <= settings["limit.max"]):
        return ()
    return (target, speed) if axis.homed or kind in ("rel", "vel") else ()
