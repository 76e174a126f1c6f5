"""Text from devices and files, made safe to show, and to hand to programs."""

from __future__ import annotations

from typing import Any

import msgspec

#: Names longer than this are cut in messages.
MAX_LENGTH = 200


def printable(text: str, *, max_length: int = MAX_LENGTH) -> str:
    r"""Return `text` with everything but printable characters and blanks replaced, at most `max_length` long.

    >>> printable("gyro\x1b[2J\u202e 7")
    'gyro?[2J? 7'
    """
    shown = "".join(character if character.isprintable() else "?" for character in text[: max_length + 1])
    return shown if len(shown) <= max_length else shown[: max_length - 1] + "…"


def json_text(value: object) -> str:
    r"""Return `value` as one line of JSON; in place of what is no Unicode, as in a file's name, stands ``?``.

    >>> json_text({"record": "north-\udcff.sqlite", "mean": float("nan")})
    '{"record":"north-?.sqlite","mean":null}'
    """
    try:
        return msgspec.json.encode(value).decode()
    except UnicodeEncodeError:
        return msgspec.json.encode(_as_unicode(msgspec.to_builtins(value))).decode()


def _as_unicode(value: Any) -> Any:  # noqa: ANN401  # any plain data
    if isinstance(value, str):
        return value.encode(errors="replace").decode()
    if isinstance(value, dict):
        return {_as_unicode(key): _as_unicode(each) for key, each in value.items()}
    return [_as_unicode(each) for each in value] if isinstance(value, list | tuple) else value
