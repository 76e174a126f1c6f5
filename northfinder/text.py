"""Text from devices and files, made safe to show."""

from __future__ import annotations

#: Names longer than this are cut in messages.
MAX_LENGTH = 200


def printable(text: str, *, max_length: int = MAX_LENGTH) -> str:
    r"""Return `text` with everything but printable characters and blanks replaced, at most `max_length` long.

    >>> printable("gyro\x1b[2J\u202e 7")
    'gyro?[2J? 7'
    """
    shown = "".join(character if character.isprintable() else "?" for character in text[: max_length + 1])
    return shown if len(shown) <= max_length else shown[: max_length - 1] + "…"
