"""The ``canopen`` package on a `drivers.api.FrameLink`: its bus, and an SDO client that waits on the host's clock."""

from __future__ import annotations

import logging
from collections.abc import Callable

import canopen
from canopen.sdo import SdoClient, SdoCommunicationError

from drivers.api import Clock, FrameLink

SDO_TIMEOUT = 0.3  # s for each answer
MAX_ANSWERS = 4096  # of one transfer: 28 KB; a server that sends more never ends

# Its warnings are about what here becomes an exception; without a handler they would go to the terminal.
logging.getLogger("canopen").addHandler(logging.NullHandler())


class SilenceError(SdoCommunicationError):
    """No answer of the SDO server came in time."""


class LinkNetwork(canopen.Network):
    """A canopen network that sends through a link; whoever owns the link hands it what arrives, by `notify`."""

    def __init__(self, link: FrameLink) -> None:
        super().__init__()
        self._link = link

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:  # noqa: FBT001, FBT002  # canopen's
        """Send a frame; remote frames are never sent."""
        if not remote:
            self._link.send(can_id, bytes(data))


class ClockedSdoClient(SdoClient):
    """An SDO client whose waiting is done by `wait`, which takes in frames until its deadline or any news."""

    def __init__(
        self, rx_cobid: int, tx_cobid: int, od: canopen.ObjectDictionary, clock: Clock, wait: Callable[[float], None]
    ) -> None:
        super().__init__(rx_cobid, tx_cobid, od)
        self._clock = clock
        self._wait = wait
        self.n_answers = 0  #: of the present transfer; set to 0 before each

    def read_response(self) -> bytes:
        """Return the next answer of the server.

        Raises
        ------
        SilenceError
            If none comes in time.
        canopen.SdoAbortedError
            If the server aborts.
        SdoCommunicationError
            If the transfer does not end.
        """
        deadline = self._clock.now() + SDO_TIMEOUT
        while self.responses.empty():
            if self._clock.now() >= deadline:
                raise SilenceError
            self._wait(deadline)
        self.n_answers += 1
        if self.n_answers > MAX_ANSWERS:
            raise SdoCommunicationError("the transfer does not end")
        response: bytes = super().read_response()  # there is one: it does not wait
        return response


class LinkNode(canopen.RemoteNode):
    """A remote node whose SDO client waits on the host's clock."""

    def __init__(
        self, node_id: int, dictionary: canopen.ObjectDictionary, clock: Clock, wait: Callable[[float], None]
    ) -> None:
        self._clock, self._wait = clock, wait
        super().__init__(node_id, dictionary)

    def add_sdo(self, rx_cobid: int, tx_cobid: int) -> ClockedSdoClient:
        """Return a new SDO client; called by the constructor."""
        client = ClockedSdoClient(rx_cobid, tx_cobid, self.object_dictionary, self._clock, self._wait)
        self.sdo_channels.append(client)
        return client
