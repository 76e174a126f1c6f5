"""Text as devices send it, made safe to show."""

from __future__ import annotations


def printable(raw: bytes) -> str:
    r"""Return bytes as text, with whatever is not printable ASCII replaced by ``?``.

    >>> printable(b"tvg43\x1b[2J\0")
    'tvg43?[2J?'
    """
    return "".join(chr(code) if 0x20 <= code < 0x7F else "?" for code in raw)


def unpadded(raw: bytes) -> str:
    r"""Return bytes up to the first zero, as `printable` has them.

    >>> unpadded(b"tvg43\0\0\0")
    'tvg43'
    """
    return printable(raw.split(b"\0")[0])
