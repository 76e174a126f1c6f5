"""One CANopen node as the drivers see it: PDOs collected, its life watched, its objects in `drivers.canopen.objects`.

Nothing here waits but `wait`, what is built on it, and access to objects. `service` sorts what has arrived; whatever a
frame holds, it raises nothing but DeviceError.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import canopen
import numpy as np
from canopen.emcy import EmcyError
from canopen.objectdictionary.eds import import_eds
from numpy.typing import NDArray

from drivers.api import DAMAGED, REPEATED, BusCounts, Clock, FrameLink
from drivers.canopen.network import LinkNetwork, LinkNode
from drivers.canopen.objects import Objects
from drivers.canopen.pdo import PdoCodec
from drivers.errors import DeviceFaultError, DeviceTimeoutError, ProtocolError

EDS_FOLDER = Path(__file__).parent.parent / "eds"
HEARTBEAT_MS = 100  #: of a node, as the drivers ask for it
MAX_SILENCE = 0.25  # s without a heartbeat; found within 300 ms by a host that looks each 50 ms
LONGEST_LOOK = 0.06  # s; a host that was away for longer has not listened for longer: at least five looks find nothing
SERVICE_PERIOD = 0.05  # s, how often a wait looks after the other duties
MAX_WAITING = 4096  # frames of one PDO that wait for the driver
OPERATIONAL = 5
PRE_OPERATIONAL = 127
_STATES = {0, 4, OPERATIONAL, PRE_OPERATIONAL}  # of a heartbeat: boot-up, stopped, these
_STATE_TIMEOUT = 1.0  # s
_TWIN_TIME = 0.02  # s in which a second node of the same number would answer
_IDENTITY = 0x1018


def load_dictionary(name: str, node_id: int) -> canopen.ObjectDictionary:
    """Return the object dictionary of one of the EDS files shipped, for a node."""
    dictionary: canopen.ObjectDictionary = import_eds(EDS_FOLDER / name, node_id)
    dictionary.node_id = node_id
    return dictionary


class Node:
    """A node on a bus.

    Parameters
    ----------
    link
        To the bus; the node closes it.
    clock
        The clock that `link` notifies.
    dictionary
        The node's object dictionary; it holds the node's number.
    title
        What it is, for messages: ``gyro``.
    """

    def __init__(self, link: FrameLink, clock: Clock, dictionary: canopen.ObjectDictionary, *, title: str) -> None:
        self.id = dictionary.node_id or 0
        self.remote = LinkNode(self.id, dictionary, clock, self.wait)
        self.max_silence = MAX_SILENCE  #: s without a heartbeat, after which the node counts as cut off
        self.duty: Callable[[], None] = lambda: None  #: done before each look at what has arrived, for heartbeats
        self.emergencies: list[EmcyError] = []  #: that the driver has not yet taken
        self.state = -1  #: NMT state in the last heartbeat, -1 if none has come
        self.was_reset = False  #: whether it has sent a boot-up message since `watch`
        self.n_malformed = 0
        self._title = title
        self._link = link
        self._clock = clock
        self._network = LinkNetwork(link)
        self._network.add_node(self.remote)
        self.objects = Objects(self.remote, self.name)
        self._pdos: dict[int, list[bytes]] = {}
        self._silence = 0.0
        self._looked_at = clock.now()
        self._watched = False
        self.remote.nmt.add_heartbeat_callback(self._on_heartbeat)
        self.remote.emcy.add_callback(self._on_emergency)
        self._lengths = {0x80 + self.id: 8, 0x580 + self.id: 8, 0x700 + self.id: 1}

    @property
    def name(self) -> str:
        """Device, number and bus, for messages: ``the gyro, node 16 on socketcan:can0``."""
        return f"the {self._title}, node {self.id} on {self._link.name}"

    @property
    def troubles(self) -> dict[str, int]:
        """What has gone wrong with this node and been made up for, as `drivers.api.Gyro.troubles`."""
        return {REPEATED: self.objects.n_repeated, DAMAGED: self.n_malformed}

    @property
    def bus(self) -> BusCounts:
        """What has been heard on the bus, by all that listen there."""
        return self._link.counts

    # What arrives

    def service(self) -> bool:
        """Do the other duty, and sort what has arrived; return whether anything has. Never waits."""
        self.duty()
        now = self._clock.now()
        self._silence += min(now - self._looked_at, LONGEST_LOOK)
        self._looked_at = now
        frames = self._link.receive()
        for identifier, data in frames:
            waiting = self._pdos.get(identifier)
            if waiting is not None:
                if len(waiting) < MAX_WAITING:
                    waiting.append(data)
            elif self._lengths.get(identifier) == len(data) and not self._is_odd(identifier, data):
                self._network.notify(identifier, bytearray(data), now)
            else:
                self.n_malformed += 1
        return bool(frames)

    def _is_odd(self, identifier: int, data: bytes) -> bool:
        """Return whether a frame is a heartbeat with a state that there is not."""
        return identifier == 0x700 + self.id and data[0] not in _STATES

    def wait(self, deadline: float) -> None:
        """Service until something has come, or `deadline`, or a service period has gone by."""
        if not self.service():
            self._clock.wait(min(deadline, self._clock.now() + SERVICE_PERIOD))
            self.service()

    def collect(self, *cob_ids: int) -> None:
        """Keep the PDOs of these identifiers for `take`, from now on."""
        for cob_id in cob_ids:
            self._pdos[cob_id] = []

    def take(self, cob_id: int) -> list[bytes]:
        """Return the PDOs of an identifier that have come, oldest first."""
        waiting = self._pdos[cob_id]
        self._pdos[cob_id] = []
        return waiting

    def take_values(self, codec: PdoCodec) -> dict[tuple[int, int], NDArray[np.int64]]:
        """Return each object's values in the frames of a PDO that have come, oldest first; ``{}`` if none have.

        Frames of another length than the PDO's are counted in `n_malformed`.
        """
        frames = self.take(codec.cob_id)
        if not frames:
            return {}
        values, n_malformed = codec.decode(frames)
        self.n_malformed += n_malformed
        return values

    def send(self, identifier: int, data: bytes) -> None:
        """Send a frame."""
        self._link.send(identifier, data)

    def close(self) -> None:
        """Release the link."""
        self._watched = False
        self._link.close()

    # Life

    def watch(self) -> None:
        """Count the silence from now, and take each boot-up message as a reset."""
        self._silence, self._watched, self.was_reset = 0.0, True, False

    def check_alive(self) -> None:
        """Raise if the node was reset, or its heartbeat has stopped, since `watch`.

        Raises
        ------
        DeviceFaultError
            If it was reset, or has left OPERATIONAL.
        DeviceTimeoutError
            If no heartbeat has come for `max_silence`.
        """
        if not self._watched:
            return
        if self.was_reset:
            raise DeviceFaultError(f"{self.name} was reset: it has sent its boot-up message; connect again")
        if self._silence > self.max_silence:
            raise DeviceTimeoutError(
                f"{self.name} has sent no heartbeat for {self._silence * 1000:.0f} ms: was it cut off?"
            )
        if self.state != OPERATIONAL:
            raise DeviceFaultError(f"{self.name} has left OPERATIONAL: another host commands it")

    def order(self, state: str) -> None:
        """Command an NMT state by canopen's name for it; the heartbeat tells later whether the node is there."""
        self.state = -1
        self.remote.nmt.state = state

    def stands_in(self, code: int) -> bool:
        """Return whether a heartbeat since the last `order` has told an NMT state."""
        return self.state == code

    def command(self, state: str, code: int) -> None:
        """Order an NMT state, and wait until a heartbeat tells it.

        Raises
        ------
        DeviceTimeoutError
            If the node does not go there.
        """
        self.order(state)
        deadline = self._clock.now() + _STATE_TIMEOUT
        while not self.stands_in(code):
            if self._clock.now() >= deadline:
                raise DeviceTimeoutError(f"{self.name} has not become {state} within {_STATE_TIMEOUT:g} s")
            self.wait(deadline)

    def greet(self) -> None:
        """See that the node answers, and that it is the only one of its number.

        Raises
        ------
        DeviceTimeoutError
            If nothing answers, with what was heard instead.
        ProtocolError
            If two nodes answer.
        """
        try:
            serial_number = self.objects.read(_IDENTITY, 4)
        except DeviceTimeoutError:
            raise self._unheard() from None
        responses = self.remote.sdo.responses
        deadline = self._clock.now() + _TWIN_TIME
        while responses.empty() and self._clock.now() < deadline:
            self.wait(deadline)
        if not responses.empty():
            second = int.from_bytes(responses.get_nowait()[4:8], "little")
            raise ProtocolError(
                f"two nodes answer as node {self.id} on {self._link.name}, with the serial numbers {serial_number} "
                f"and {second}: give one of them another number"
            )

    def _unheard(self) -> DeviceTimeoutError:
        """Return the exception for a node that does not answer, with what was heard on the bus instead."""
        counts = self.bus
        nodes = sorted({identifier & 0x7F for identifier in counts.identifiers if identifier & 0x7F})
        if counts.n_errors:
            heard = f"{counts.n_errors} error frames came: is the bit rate right, and the cable whole?"
        elif nodes:
            heard = f"others speak there ({', '.join(map(str, nodes[:8]))}): has it this number, and power?"
        else:
            heard = "the bus is silent: is it powered, and is this its bit rate?"
        return DeviceTimeoutError(f"{self.name} does not answer; {heard}")

    def _on_heartbeat(self, state: int) -> None:
        """Take a heartbeat; state 0 is a boot-up message."""
        self.state = state
        self._silence = 0.0
        self.was_reset = self.was_reset or state == 0

    def _on_emergency(self, emergency: EmcyError) -> None:
        """Take an EMCY; canopen's own lists would grow for ever."""
        self.remote.emcy.reset()
        if len(self.emergencies) < MAX_WAITING:
            self.emergencies.append(emergency)
