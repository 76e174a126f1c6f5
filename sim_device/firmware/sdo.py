"""An SDO server: one transfer at a time, expedited or segmented, either way (CiA 301, 7.2.4)."""

import struct

from sim_device.firmware.dictionary import TOO_LONG, WRONG_LENGTH, Abort, Dictionary

TOGGLE_BIT = 0x05030000
UNKNOWN_COMMAND = 0x05040001

_DOWNLOAD_SEGMENT, _DOWNLOAD, _UPLOAD, _UPLOAD_SEGMENT, _ABORT = range(5)  # of the client, in its first three bits


class SdoServer:
    """Answers requests about the objects of a dictionary."""

    def __init__(self, dictionary: Dictionary) -> None:
        self._dictionary = dictionary
        self._key = 0  # of the transfer, or of the request
        self._toggle = 0
        self._incoming = None  # type: bytearray | None
        self._longest = 0
        self._announced = -1  # length of a download, -1 if not told
        self._outgoing = None  # type: bytes | None

    def reset(self) -> None:
        """Give up the transfer, if there is one."""
        self._incoming = self._outgoing = None

    def answer(self, request: bytes) -> bytes:
        """Return the answer to a request, empty if there is none."""
        try:
            return self._serve(request)
        except Abort as abort:
            self.reset()
            return struct.pack("<BHBI", 0x80, self._key >> 8, self._key & 0xFF, abort.code)

    def _serve(self, request: bytes) -> bytes:
        command = request[0] >> 5
        if command == _DOWNLOAD_SEGMENT:
            return self._take_segment(request)
        if command == _UPLOAD_SEGMENT:
            return self._give_segment(request)
        self.reset()
        if command == _ABORT:
            return b""
        index, subindex = struct.unpack_from("<HB", request, 1)
        self._key = index << 8 | subindex
        if command == _DOWNLOAD:
            return self._download(request)
        if command == _UPLOAD:
            return self._upload(request)
        raise Abort(UNKNOWN_COMMAND)

    def _download(self, request: bytes) -> bytes:
        expedited, sized, unused = request[0] & 2, request[0] & 1, request[0] >> 2 & 3
        longest = self._dictionary.check_writable(self._key)
        if expedited:
            length = 4 - unused if sized else min(4, longest)
            self._dictionary.write(self._key, request[4 : 4 + length])
        else:
            self._announced = struct.unpack_from("<I", request, 4)[0] if sized else -1
            if sized:
                self._dictionary.check_length(self._key, self._announced)
            self._incoming = bytearray()
            self._longest = longest
            self._toggle = 0
        return b"\x60" + request[1:4] + bytes(4)

    def _take_segment(self, request: bytes) -> bytes:
        if self._incoming is None:
            raise Abort(UNKNOWN_COMMAND)
        toggle = self._flip(request)
        self._incoming.extend(request[1 : 8 - (request[0] >> 1 & 7)])
        if len(self._incoming) > self._longest:
            raise Abort(TOO_LONG)
        if request[0] & 1:
            data = bytes(self._incoming)
            self.reset()
            if self._announced not in {-1, len(data)}:
                raise Abort(WRONG_LENGTH)
            self._dictionary.write(self._key, data)
        return bytes((0x20 | toggle,)) + bytes(7)

    def _upload(self, request: bytes) -> bytes:
        data = self._dictionary.read(self._key)
        if 0 < len(data) <= 4:
            return bytes((0x43 | (4 - len(data)) << 2,)) + request[1:4] + data + bytes(4 - len(data))
        self._outgoing = data
        self._toggle = 0
        return b"\x41" + request[1:4] + struct.pack("<I", len(data))

    def _give_segment(self, request: bytes) -> bytes:
        if self._outgoing is None:
            raise Abort(UNKNOWN_COMMAND)
        toggle = self._flip(request)
        part, rest = self._outgoing[:7], self._outgoing[7:]
        self._outgoing = rest or None
        return bytes((toggle | (7 - len(part)) << 1 | (not rest),)) + part + bytes(7 - len(part))

    def _flip(self, request: bytes) -> int:
        """Check the toggle bit of a segment, and return it in its place."""
        toggle = request[0] & 0x10
        if toggle != self._toggle:
            raise Abort(TOGGLE_BIT)
        self._toggle ^= 0x10
        return toggle
