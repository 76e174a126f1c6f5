"""Record and decode the traffic of a CAN bench with the names of its objects.

    python tools/canlog.py socketcan:can0@1000000                      listen, until interrupted
    python tools/canlog.py slcan:/dev/ttyACM0@1000000 --out bench.asc  and keep it (.asc, .blf, .log, .csv, .trc, ...)
    python tools/canlog.py bench.asc                                   decode a recording, by whatever program
    python tools/canlog.py bench.asc --node 33                         of one node alone
    python tools/canlog.py bench.asc --gyro 17 --axis 40 --axis 41     where the nodes have other numbers

A line is: time in s, identifier, who and what, and the objects with their values in the units of ``docs/canopen.md``.
It sends nothing.
"""

from __future__ import annotations

import argparse
import contextlib
import signal
import sys
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import can
import canopen
from canopen.emcy import EmcyError
from canopen.objectdictionary.datatypes import SIGNED_TYPES
from canopen.sdo import SdoAbortedError

from drivers.canopen.node import load_dictionary
from drivers.canopen.pdo import PdoCodec
from drivers.cia402.words import drive_state, fault_name
from drivers.transport.can_address import SET_BITRATE, BusAddress, parse_bus_address, split_socketcand

GYRO_EDS, AXIS_EDS = "gyro.eds", "cia402_stage.eds"
_STATES = {0: "boot-up", 4: "stopped", 5: "operational", 127: "pre-operational"}
_COMMANDS = {1: "start", 2: "stop", 128: "pre-operational", 129: "reset node", 130: "reset communication"}


class Decoder:
    """Says what a frame is.

    Parameters
    ----------
    nodes
        The EDS file of each node by its number.
    """

    def __init__(self, nodes: dict[int, str]) -> None:
        self._nodes = {
            number: canopen.RemoteNode(number, load_dictionary(eds, number)) for number, eds in nodes.items()
        }
        self._titles = {number: "gyro" if eds == GYRO_EDS else "axis" for number, eds in nodes.items()}
        network = canopen.Network()  # never connected: a mapping wants one to subscribe to
        self._pdos: dict[int, tuple[int, str, PdoCodec, canopen.pdo.PdoMap]] = {}
        for number, node in self._nodes.items():
            network.add_node(node)
            for kind, pdos in (("TPDO", node.tpdo), ("RPDO", node.rpdo)):
                for index, pdo in pdos.items():
                    codec = PdoCodec(pdo)
                    self._pdos[codec.cob_id] = number, f"{kind} {index}", codec, pdo

    def describe(self, identifier: int, data: bytes) -> str:
        """Return who says what in a data frame of an 11-bit identifier."""
        if identifier in self._pdos:
            return self._pdo(*self._pdos[identifier], data)
        node, function = identifier & 0x7F, identifier & 0x780
        if identifier == 0 and len(data) == 2:
            return (
                f"NMT {_COMMANDS.get(data[0], f'command {data[0]}')}, {f'node {data[1]}' if data[1] else 'all nodes'}"
            )
        if identifier == 0x80:
            return "SYNC"
        if function == 0x80 and len(data) == 8:
            return f"{self._who(node)} EMCY {_emergency(data)}"
        if function == 0x700 and len(data) == 1:
            return f"{self._who(node)} heartbeat, {_STATES.get(data[0] & 0x7F, f'state {data[0]}')}"
        if function in {0x580, 0x600} and len(data) == 8:
            return f"{self._who(node)} SDO {self._sdo(node, data, answer=function == 0x580)}"
        return "unknown"

    def _who(self, node: int) -> str:
        return f"{self._titles.get(node, 'host' if node == 127 else 'node')} {node}"

    def _pdo(self, node: int, name: str, codec: PdoCodec, pdo: canopen.pdo.PdoMap, data: bytes) -> str:
        values, n_malformed = codec.decode([data])
        if n_malformed:
            return f"{self._who(node)} {name} of {len(data)} bytes, not {codec.length}"
        texts = []
        for each in pdo.map:
            value = int(values[each.index, each.subindex][0])
            texts.append(f"{each.od.name} {_shown(each.index, value)}")
        return f"{self._who(node)} {name}: {', '.join(texts)}"

    def _sdo(self, node: int, data: bytes, *, answer: bool) -> str:
        command = data[0] >> 5
        index, subindex = int.from_bytes(data[1:3], "little"), data[3]
        name = self._object(node, index, subindex)
        if data[0] == 0x80:
            code = int.from_bytes(data[4:8], "little")
            return f"abort of {name}: {SdoAbortedError.CODES.get(code, 'unknown reason')} ({code:08X})"
        carries = command == (2 if answer else 1)
        if carries and data[0] & 2:
            size = 4 - (data[0] >> 2 & 3) if data[0] & 1 else 4
            return f"{'read' if answer else 'write'} {name}: {self._value(node, index, subindex, data[4 : 4 + size])}"
        if command in ({2, 3} if answer else {1, 2}):
            return f"{ {2: 'read', 3: 'written', 1: 'write'}[command] if answer or command == 1 else 'read?' } {name}"
        return f"segment {data[1:].hex(' ')}"

    def _object(self, node: int, index: int, subindex: int) -> str:
        variable = self._nodes[node].object_dictionary.get_variable(index, subindex) if node in self._nodes else None
        label = f"{index:04X}:{subindex}"
        return label if variable is None else f"{variable.name} ({label})"

    def _value(self, node: int, index: int, subindex: int, data: bytes) -> str:
        variable = self._nodes[node].object_dictionary.get_variable(index, subindex) if node in self._nodes else None
        signed = variable is not None and variable.data_type in SIGNED_TYPES
        return _shown(index, int.from_bytes(data, "little", signed=signed))


def _shown(index: int, value: int) -> str:
    """Return a value, words of CiA 402 with what they mean."""
    if index == 0x6041:
        state = drive_state(value)
        return f"{value:04X} ({state.name if state else 'no state'})"
    return f"{value:04X}" if index == 0x6040 else str(value)


def _emergency(data: bytes) -> str:
    code = int.from_bytes(data[:2], "little")
    if not code >> 8:
        return "no error"
    name = fault_name(code)
    if name.startswith("fault"):
        name = EmcyError(code, data[2], data[3:], 0.0).get_desc()
    return f"{code:04X} {name}"


def line_of(message: can.Message, decoder: Decoder) -> str:
    """Return a frame as one line."""
    if message.is_error_frame:
        what = f"ERROR FRAME {message.arbitration_id:X}"
    elif message.is_remote_frame:
        what = "remote frame"
    elif message.is_extended_id:
        what = f"unknown [{message.data.hex(' ')}]"
    else:
        what = decoder.describe(message.arbitration_id, bytes(message.data))
        if what == "unknown":
            what += f" [{message.data.hex(' ')}]"
    width = 8 if message.is_extended_id else 3
    return f"{message.timestamp:14.6f}  {message.arbitration_id:0{width}X}  {what}"


def open_source(source: str) -> contextlib.AbstractContextManager[Iterable[can.Message]]:
    """Return what yields frames: a recording, if there is such a file, else a bus. ValueError if it is neither."""
    if Path(source).is_file():
        return can.LogReader(source)
    return contextlib.closing(_Listener(parse_bus_address(source)))


class _Listener:
    """A bus as an endless row of frames."""

    def __init__(self, address: BusAddress) -> None:
        if address.interface == "socketcand":
            host, port, channel = split_socketcand(address.channel)
            self._bus = can.Bus(channel, interface="socketcand", host=host, port=port)
        else:
            options: dict[str, Any] = {"bitrate": address.bitrate} if address.interface in SET_BITRATE else {}
            self._bus = can.Bus(address.channel, interface=address.interface, **options)

    def __iter__(self) -> Iterator[can.Message]:
        while True:
            message = self._bus.recv(0.5)
            if message is not None:
                yield message

    def close(self) -> None:
        """Leave the bus."""
        self._bus.shutdown()


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return its exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", help="INTERFACE:CHANNEL[@BITRATE], or the file of a recording")
    parser.add_argument("--out", metavar="FILE", help="record to this file; its ending says how")
    parser.add_argument("--gyro", type=int, action="append", metavar="NODE", help="number of a gyro (16)")
    parser.add_argument("--axis", type=int, action="append", metavar="NODE", help="number of an axis (32 and 33)")
    parser.add_argument("--node", type=int, action="append", metavar="NODE", help="show this node alone")
    parser.add_argument("--seconds", type=float, metavar="S", help="stop listening after so long")
    parser.add_argument("--quiet", action="store_true", help="record, and show nothing")
    given = parser.parse_args(arguments)
    nodes = dict.fromkeys(given.gyro or [16], GYRO_EDS) | dict.fromkeys(given.axis or [32, 33], AXIS_EDS)
    try:
        decoder = Decoder(nodes)
        with open_source(given.source) as messages, contextlib.ExitStack() as stack:
            keep = stack.enter_context(can.Logger(given.out)) if given.out else None
            deadline = None if given.seconds is None else time.monotonic() + given.seconds
            for message in messages:
                if keep is not None:
                    keep.on_message_received(message)
                wanted = given.node is None or message.arbitration_id & 0x7F in given.node
                if wanted and not given.quiet:
                    print(line_of(message, decoder))
                if deadline is not None and time.monotonic() >= deadline:
                    break
    except (ValueError, OSError, can.CanError) as error:
        print(f"canlog: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        pass
    return 0


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # ended in order, as by Ctrl-C
    sys.exit(main())
