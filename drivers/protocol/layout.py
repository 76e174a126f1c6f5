"""NumPy's view of a construct declaration, so that a layout is written down once."""

from __future__ import annotations

from typing import Any

import numpy as np
from construct import Array, Bytes, BytesInteger, Container, FormatField, Struct, Subconstruct
from numpy.typing import NDArray


def numpy_dtype(layout: Struct, **counts: int) -> np.dtype[np.void]:
    """Return the structured dtype with the same bytes as `layout`.

    Parameters
    ----------
    layout
        A Struct of numbers, constants, fixed bytes and arrays of them. Integers of three bytes, for which NumPy has no
        type, stay bytes: a last dimension of 3, see `integers24`.
    **counts
        Values of the fields that array lengths refer to.

    Raises
    ------
    TypeError
        If the layout holds something whose length or form depends on more than `counts`.
    """
    return np.dtype([(member.name, *_element(member.subcon, Container(counts))) for member in layout.subcons])


def _element(declared: Any, counts: Container) -> tuple[str, tuple[int, ...]]:  # noqa: ANN401  # construct has no types
    """Return NumPy's format and shape of one declared element."""
    if isinstance(declared, FormatField):
        code = declared.fmtstr[-1]
        kind = "f" if code in "fd" else "u" if code.isupper() else "i"
        return f"{declared.fmtstr[0]}{kind}{declared.sizeof()}", ()
    if isinstance(declared, Array):
        code, shape = _element(declared.subcon, counts)
        count = declared.count(counts) if callable(declared.count) else declared.count
        return code, (count, *shape)
    if isinstance(declared, BytesInteger):
        return "u1", (declared.length,)
    if isinstance(declared, Subconstruct):  # Const, Default
        return _element(declared.subcon, counts)
    if isinstance(declared, Bytes):
        return f"V{declared.sizeof()}", ()
    raise TypeError(f"no NumPy type for {declared!r}")


def integers24(raw: NDArray[np.uint8]) -> NDArray[np.int32]:
    """Return big-endian integers of three bytes in two's complement, shape of `raw` without its last dimension."""
    high = raw[..., 0].view(np.int8).astype(np.int32)
    return (high << 16) | (raw[..., 1].astype(np.int32) << 8) | raw[..., 2]
