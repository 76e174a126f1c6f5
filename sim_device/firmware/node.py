"""A CANopen node: NMT, heartbeat, SDO, PDO, SYNC and emergencies (CiA 301), around what the device does.

See ``docs/canopen.md``, section 2. A node is a function of time: `feed`, `poll`, `next_due_us`.
"""

import struct

from sim_device.firmware.dictionary import WRONG_STATE, Abort, Dictionary
from sim_device.firmware.hardware import Board
from sim_device.firmware.pdo import Pdo
from sim_device.firmware.sdo import SdoServer

NMT = 0x000
SYNC = 0x080

STARTED, STOP, PREPARE, RESET_NODE, RESET_COMMUNICATION = 1, 2, 128, 129, 130  # NMT commands
STOPPED, OPERATIONAL, PRE_OPERATIONAL = 4, 5, 127  # NMT states

_STATES = {STARTED: OPERATIONAL, STOP: STOPPED, PREPARE: PRE_OPERATIONAL}
_LAST_SYNC_TYPE = 240  # transmission types beyond are of events
_PDO_TOO_SHORT = 0x8210
_PDO_REFUSED = 0x6320
_COMMUNICATION = 0x10  # bits of the error register
DEVICE_PROFILE = 0x20
MANUFACTURER = 0x80
_TESTED, _TESTING = 2, 1


class Node:
    """A node on the bus.

    Parameters
    ----------
    board : Board
        The hardware, or its emulation.
    node_id : int
        1 to 127.
    entries : list
        Of the object dictionary.

    Attributes
    ----------
    state : int
        Of NMT.
    dictionary : Dictionary
        Its objects.
    """

    def __init__(self, board: Board, node_id: int, entries: list) -> None:  # type: ignore[type-arg]  # MicroPython
        self.node_id = node_id
        self.state = PRE_OPERATIONAL
        self.dictionary = Dictionary(entries, node_id)
        self._board = board
        self._now_us = 0
        self._sdo = SdoServer(self.dictionary)
        self._out: list[tuple[int, bytes]] = []
        self._register = 0  # causes in the error register
        self._test_due_us = -1
        self._heartbeat_us = 0  # of the last one sent
        indices = sorted({entry[0] for entry in entries})
        self._receive = [Pdo(self.dictionary, index) for index in indices if 0x1400 <= index < 0x1600]
        self._transmit = [Pdo(self.dictionary, index) for index in indices if 0x1800 <= index < 0x1A00]
        for key, text in ((0x100800, board.model), (0x200300, board.serial_number)):
            self.dictionary.define(key, text)
        digits = "".join([character for character in board.serial_number if "0" <= character <= "9"])
        self.dictionary.define(0x101804, int(digits or "0") & 0xFFFFFFFF)
        self.dictionary.define(0x200200, board.boot_count)
        self.dictionary.on_read(0x100100, self._error_register)
        self.dictionary.on_write(0x203001, self._start_self_test)
        self._boot_up()

    # the bus

    def accepts(self, identifier: int) -> bool:
        """Return whether this node listens to an identifier: what its controller's filter would be set to."""
        if identifier in {NMT, SYNC, 0x600 + self.node_id}:
            return True
        return any(pdo.identifier == identifier for pdo in self._receive)

    def feed(self, identifier: int, data: bytes, now_us: int) -> None:
        """Take a frame from the bus."""
        self._now_us = now_us
        if identifier == NMT:
            self._command(data)
        elif self.state == STOPPED:
            self._heard(identifier, data)
        elif identifier == 0x600 + self.node_id:
            if len(data) == 8:
                self._answer(data)
        elif identifier == SYNC:
            self._synchronise()
        else:
            self._heard(identifier, data)
            self._take(identifier, data)
        self._conclude(now_us)
        self._send_triggered()

    def poll(self, now_us: int) -> list[tuple[int, bytes]]:
        """Do all that is due, in order of time, and return the frames to send."""
        due = self._work_due_us()
        while due <= now_us:
            self._now_us = max(due, self._now_us)
            self._work_generally()
            self._work(self._now_us)
            self._conclude(self._now_us)
            self._send_triggered()
            due = self._work_due_us()
        out = self._out
        self._out = []
        return out

    def next_due_us(self) -> int:
        """Return when `poll` will have something to do."""
        return self._now_us if self._out else self._work_due_us()

    # what a device adds

    def _work(self, now_us: int) -> None:
        """Do what is due at this instant."""

    def _due_us(self) -> "int | None":
        """Return when there will be something to do, None if not before something is fed."""
        return None

    def _conclude(self, now_us: int) -> None:
        """Do what follows from what has been heard or done."""

    def _heard(self, identifier: int, data: bytes) -> None:
        """Take note of a frame that may be a heartbeat."""

    def _left_operational(self, command: int) -> None:
        """Come to rest, whatever the NMT command is."""

    def _refused(self) -> None:
        """Forget what came with a PDO of which a value was refused."""

    def _at_work(self) -> bool:
        """Return whether there can be no self-test now."""
        return False

    # what the emulator asks

    @property
    def session(self) -> int:
        """Whether there is a host that reads what this node says."""
        return int(self.testing)

    @property
    def seen_time_us(self) -> int:
        """Newest device time that the host says it has read, 0 if none."""
        return 0

    # for the device

    @property
    def testing(self) -> bool:
        """Whether the self-test runs."""
        return self._test_due_us >= 0

    def _send(self, identifier: int, data: bytes) -> None:
        self._out.append((identifier, data))

    def _trigger(self, number: int) -> None:
        """Let transmit PDO `number`, counted from 1, go out."""
        self._transmit[number - 1].triggered = True

    def _emergency(self, code: int, cause: int = 0) -> None:
        """Report an error, and keep `cause` in the error register."""
        self._register |= cause
        self._send(SYNC + self.node_id, struct.pack("<HB5s", code, self._error_register(), bytes(5)))

    def _recovered(self, cause: int) -> None:
        """Report that a cause of errors has gone."""
        if self._register & cause:
            self._register &= ~cause
            self._emergency(0)

    # work in time

    def _work_due_us(self) -> int:
        dues = [due for due in (self._due_us(), self._heartbeat_due_us()) if due is not None]
        if self.testing:
            dues.append(self._test_due_us)
        if self.state == OPERATIONAL:
            timed = [pdo for pdo in self._transmit if pdo.timer_us and pdo.kind > _LAST_SYNC_TYPE]
            dues += [pdo.sent_us + pdo.timer_us for pdo in timed]
        return min(dues) if dues else 1 << 62

    def _heartbeat_due_us(self) -> "int | None":
        period_us = self.dictionary.get(0x101700) * 1000
        return self._heartbeat_us + period_us if period_us else None

    def _work_generally(self) -> None:
        now_us = self._now_us
        due = self._heartbeat_due_us()
        if due is not None and due <= now_us:
            self._heartbeat_us = now_us
            self._send(0x700 + self.node_id, bytes((self.state,)))
        if self.testing and self._test_due_us <= now_us:
            self._test_due_us = -1
            self.dictionary.put(0x203002, _TESTED)
            self.dictionary.put(0x203003, self._board.self_test())
        if self.state == OPERATIONAL:
            for pdo in self._transmit:
                if pdo.timer_us and pdo.kind > _LAST_SYNC_TYPE and pdo.sent_us + pdo.timer_us <= now_us:
                    pdo.triggered = True

    # NMT

    def _command(self, data: bytes) -> None:
        if len(data) != 2 or data[1] not in {0, self.node_id}:
            return
        command = data[0]
        if command not in {STARTED, STOP, PREPARE, RESET_NODE, RESET_COMMUNICATION}:
            return
        if command != STARTED:
            self._left_operational(command)
        if command in _STATES:
            started = command == STARTED and self.state != OPERATIONAL
            self.state = _STATES[command]
            if started:
                self._start()
            return
        self.dictionary.reset(0x1000, 0x1FFF if command == RESET_COMMUNICATION else 0xFFFF)
        self._test_due_us = -1
        self._boot_up()

    def _start(self) -> None:
        """Send the PDOs of events, so that the host knows where it starts."""
        for pdo in self._transmit:
            pdo.triggered = pdo.kind == 255
            pdo.sent_us = self._now_us

    def _boot_up(self) -> None:
        self.state = PRE_OPERATIONAL
        self._sdo.reset()
        for pdo in self._receive + self._transmit:
            pdo.compile()
        self._heartbeat_us = self._now_us
        self._send(0x700 + self.node_id, b"\x00")

    # SDO

    def _answer(self, request: bytes) -> None:
        answer = self._sdo.answer(request)
        if answer:
            self._send(0x580 + self.node_id, answer)

    # PDO

    def _take(self, identifier: int, data: bytes) -> None:
        if self.state != OPERATIONAL:
            return
        for pdo in self._receive:
            if pdo.identifier != identifier:
                continue
            if len(data) < pdo.length:
                if not self._register & _COMMUNICATION:
                    self._emergency(_PDO_TOO_SHORT, _COMMUNICATION)
                continue
            self._recovered(_COMMUNICATION)
            if pdo.kind > _LAST_SYNC_TYPE:
                self._apply(pdo, data)
            else:
                pdo.received = data

    def _apply(self, pdo: Pdo, data: bytes) -> None:
        """Store all objects of a PDO, of which the device then acts on the whole."""
        begin = 0
        refused = False
        for key in pdo.keys:
            end = begin + self.dictionary.size(key)
            try:
                self.dictionary.write(key, data[begin:end])
            except Abort:
                refused = True
            begin = end
        if refused:
            self._refused()
            self._emergency(_PDO_REFUSED)

    def _synchronise(self) -> None:
        if self.state != OPERATIONAL:
            return
        for pdo in self._receive:
            if pdo.received:
                data, pdo.received = pdo.received, b""
                self._apply(pdo, data)
                self._conclude(self._now_us)
        for pdo in self._transmit:
            if pdo.kind > _LAST_SYNC_TYPE or pdo.identifier == -1:
                continue
            pdo.n_syncs += 1
            if pdo.triggered if pdo.kind == 0 else pdo.n_syncs >= pdo.kind:
                self._transmit_now(pdo)

    def _send_triggered(self) -> None:
        if self.state != OPERATIONAL:
            return
        for pdo in reversed(self._transmit):
            if pdo.triggered and pdo.kind > _LAST_SYNC_TYPE:
                self._transmit_now(pdo)

    def _transmit_now(self, pdo: Pdo) -> None:
        pdo.triggered = False
        pdo.n_syncs = 0
        pdo.sent_us = self._now_us
        if pdo.identifier != -1:
            self._send(pdo.identifier, pdo.data())

    # objects

    def _error_register(self) -> int:
        return self._register | (1 if self._register else 0)

    def _start_self_test(self, value: int) -> int:
        if value:
            if self.testing or self._at_work():
                raise Abort(WRONG_STATE)
            self._test_due_us = self._now_us + self._board.self_test_us()
            self.dictionary.put(0x203002, _TESTING)
        return 0
