"""The objects of a CANopen node, read and written by SDO; canopen's exceptions become ours here."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import canopen
from canopen.objectdictionary import ODVariable
from canopen.objectdictionary.datatypes import SIGNED_TYPES
from canopen.sdo import SdoAbortedError, SdoCommunicationError

from drivers.canopen.network import SDO_TIMEOUT, LinkNode, SilenceError
from drivers.errors import DeviceError, DeviceFaultError, DeviceTimeoutError, ProtocolError
from drivers.protocol.text import unpadded

_ATTEMPTS = 3
#: Abort codes by which a device refuses what host and device both understand.
_REFUSALS = {0x06060000, 0x06090030, 0x06090031, 0x06090032, 0x08000020, 0x08000021, 0x08000022}
_MISSING = {0x06020000, 0x06090011}
T = TypeVar("T")


class MissingObjectError(ProtocolError):
    """The device has no such object."""


class Objects:
    """What a node holds by index and subindex, as its object dictionary says; `name` is the node's, for messages."""

    def __init__(self, remote: LinkNode, name: str) -> None:
        self.name = name
        self._remote = remote
        self.n_repeated = 0  #: transfers that were begun again because nothing had answered

    def read(self, index: int, subindex: int = 0) -> int:
        """Return the value of a number.

        Raises
        ------
        DeviceTimeoutError
            If the node does not answer.
        ProtocolError, DeviceFaultError
            If it refuses, or answers with something else.
        """
        variable = self._variable(index, subindex)
        data = self._transfer(f"reading {_called(variable)}", lambda: self._remote.sdo.upload(index, subindex))
        if len(data) * 8 != len(variable):
            raise ProtocolError(
                f"{self.name} answered {len(data)} bytes for {_called(variable)}, {len(variable) // 8} were expected"
            )
        return int.from_bytes(data, "little", signed=variable.data_type in SIGNED_TYPES)

    def default(self, index: int, subindex: int = 0) -> int:
        """Return what the object dictionary says of a number's value at start, 0 if nothing."""
        return self._variable(index, subindex).default or 0

    def read_optional(self, index: int, subindex: int = 0) -> int | None:
        """Return the value of a number, None if the node has no such object."""
        try:
            return self.read(index, subindex)
        except MissingObjectError:
            return None

    def read_text(self, index: int) -> str:
        """Return a text up to its padding, printable: what else there is becomes ``?``. Raises as `read`."""
        variable = self._variable(index, 0)
        data = self._transfer(f"reading {_called(variable)}", lambda: self._remote.sdo.upload(index, 0))
        return unpadded(data)

    def write(self, index: int, subindex: int, value: int, *, verify: bool = False) -> None:
        """Write a number, and read it back if asked to. Raises as `read`; ProtocolError if it reads back otherwise."""
        variable = self._variable(index, subindex)
        signed = variable.data_type in SIGNED_TYPES
        data = value.to_bytes(len(variable) // 8, "little", signed=signed)
        what = f"writing {value} to {_called(variable)}"
        self._transfer(what, lambda: self._remote.sdo.download(index, subindex, data))
        if verify and (kept := self.read(index, subindex)) != value:
            raise ProtocolError(f"{self.name} kept {kept} after {what}")

    def save(self, pdo: canopen.pdo.PdoMap) -> None:
        """Give the node a PDO's parameters and mapping. Raises as `read`."""
        self._transfer(f"its mapping of PDO {pdo.cob_id or 0:03X}", pdo.save)

    def _transfer(self, what: str, transfer: Callable[[], T]) -> T:
        """Run a transfer, up to three times if nothing answers; turn canopen's exceptions into ours."""
        for attempt in range(_ATTEMPTS):
            self.n_repeated += attempt > 0
            self._remote.sdo.n_answers = 0
            try:
                return transfer()
            except SilenceError:
                continue
            except SdoAbortedError as error:
                raise self._refusal(what, error) from None
            except SdoCommunicationError as error:
                raise ProtocolError(f"{self.name} does not answer {what} as it should: {error}") from None
        raise DeviceTimeoutError(f"{self.name} did not answer {what} within {_ATTEMPTS * SDO_TIMEOUT:.1f} s")

    def _refusal(self, what: str, error: SdoAbortedError) -> DeviceError:
        text = (
            f"{self.name} refused {what}: {SdoAbortedError.CODES.get(error.code, 'unknown reason')} ({error.code:08X})"
        )
        if error.code in _MISSING:
            return MissingObjectError(text)
        return DeviceFaultError(text) if error.code in _REFUSALS else ProtocolError(text)

    def _variable(self, index: int, subindex: int) -> ODVariable:
        variable = self._remote.object_dictionary.get_variable(index, subindex)
        if variable is None:
            raise ValueError(f"there is no object {index:04X}:{subindex} in the dictionary of {self.name}")
        return variable


def _called(variable: ODVariable) -> str:
    """Return how an object is called, for messages: ``Boot count (2002)``."""
    parent = variable.parent
    if isinstance(parent, canopen.ObjectDictionary):
        return f"{variable.name} ({variable.index:04X})"
    return f"{variable.name} ({variable.index:04X}:{variable.subindex})"
