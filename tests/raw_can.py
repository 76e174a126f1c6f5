"""A host for the CAN nodes' own tests: frames by hand, in virtual time, and what came back."""

import struct
from collections.abc import Sequence

from sim_device.firmware.node import Node

HOST = 127
START, STOP, PREPARE, RESET_NODE, RESET_COMMUNICATION = 1, 2, 128, 129, 130
SECOND = 1_000_000


class RefusedError(Exception):
    """An SDO abort."""

    def __init__(self, code: int) -> None:
        super().__init__(f"{code:08X}")
        self.code = code


class RawCanHost:
    """The other end of a wire with some nodes, in their own time."""

    def __init__(self, *nodes: Node) -> None:
        self.nodes: Sequence[Node] = nodes
        self.now_us = 0
        self.beats = True  #: whether it sends its heartbeat
        self.heard: list[tuple[int, int, bytes]] = []
        self._beaten_us = 0
        self._collect()

    def send(self, identifier: int, data: bytes) -> None:
        """Send a frame now."""
        for node in self.nodes:
            if node.accepts(identifier):
                node.feed(identifier, data, self.now_us)
        self._collect()

    def run(self, duration_us: int) -> None:
        """Let time pass, from one thing that is due to the next."""
        end_us = self.now_us + duration_us
        while True:
            due = min(node.next_due_us() for node in self.nodes)
            if self.beats:
                due = min(due, self._beaten_us + 50_000)
            if due > end_us:
                break
            self.now_us = max(due, self.now_us)
            if self.beats and self._beaten_us + 50_000 <= self.now_us:
                self._beaten_us = self.now_us
                self.send(0x700 + HOST, b"\x05")
            self._collect()
        self.now_us = end_us
        self._collect()

    def nmt(self, command: int, node_id: int = 0) -> None:
        """Command one node or all."""
        self.send(0, bytes((command, node_id)))

    def data(self, identifier: int) -> list[bytes]:
        """Return what has been heard under an identifier since the last `forget`."""
        return [data for _, heard, data in self.heard if heard == identifier]

    def forget(self) -> None:
        """Forget what has been heard."""
        self.heard.clear()

    def request(self, data: bytes, node: int = 0) -> bytes:
        """Send an SDO request and return the answer; RefusedError if it is an abort."""
        node_id = self.nodes[node].node_id
        before = len(self.heard)
        self.send(0x600 + node_id, data)
        answers = [data for _, identifier, data in self.heard[before:] if identifier == 0x580 + node_id]
        assert len(answers) == 1
        if answers[0][0] == 0x80:
            raise RefusedError(struct.unpack_from("<I", answers[0], 4)[0])
        return answers[0]

    def read(self, index: int, subindex: int = 0, node: int = 0) -> int:
        """Return the unsigned number of an object of up to four bytes."""
        answer = self.request(struct.pack("<BHB4x", 0x40, index, subindex), node)
        length = 4 - (answer[0] >> 2 & 3)
        return int.from_bytes(answer[4 : 4 + length], "little")

    def write(self, index: int, value: int, size: int, *, subindex: int = 0, node: int = 0) -> None:
        """Write a number of `size` bytes."""
        payload = (value & (1 << 8 * size) - 1).to_bytes(4, "little")
        self.request(struct.pack("<BHB", 0x23 | 4 - size << 2, index, subindex) + payload, node)

    def _collect(self) -> None:
        for node in self.nodes:
            self.heard += [(self.now_us, identifier, data) for identifier, data in node.poll(self.now_us)]
