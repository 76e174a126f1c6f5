"""TOML files into frozen structs, with one sentence for whatever is wrong with them."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

import msgspec

from northfinder.errors import ConfigError

T = TypeVar("T")

#: No configuration of ours comes near it; a larger file is some other file.
MAX_BYTES = 1_000_000


def read_toml(path: Path, table: type[T]) -> T:
    """Read a TOML file as `table`, a msgspec Struct.

    Raises ConfigError naming the file, the key, what was found and what was expected.
    """
    try:
        with path.open("rb") as file:
            text = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    if len(text) > MAX_BYTES:
        raise ConfigError(f"{path}: larger than {MAX_BYTES} bytes, so no configuration")
    return decode_toml(text, table, source=str(path))


def decode_toml(text: bytes, table: type[T], *, source: str) -> T:
    """Decode TOML `text` that came from `source`. Raises ConfigError."""
    try:
        return msgspec.toml.decode(text, type=table)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{source}: {error}") from None
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{source}: not valid TOML: {error}") from None
