"""The native protocol's layouts: as the document defines them, and both ways through the golden frames."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from construct import Array, Bytes, Const, Construct, Default, FormatField, Int8ul, Struct
from fastcrc import crc32
from golden import GOLDEN, Golden
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.errors import ProtocolError
from drivers.protocol.framing import FrameDecoder, encode_frame
from drivers.protocol.layout import numpy_dtype
from drivers.protocol.native import (
    DEFINITION_HASH,
    LAYOUTS,
    PROTOCOL_VERSION,
    ErrorCode,
    Fault,
    MessageType,
    StageCode,
    build,
    decode_samples,
    message_type,
    parse,
)

DOCUMENT = (Path(__file__).parents[1] / "docs" / "protocol.md").read_text(encoding="utf-8")
DEFINITION = re.search(r"```definition\n(.*?)```", DOCUMENT, re.DOTALL)


def element(declared: Construct) -> str:
    """Write a construct element as the definition does."""
    if isinstance(declared, FormatField):
        sign = "u" if declared.fmtstr[-1].isupper() else "i"
        assert declared.fmtstr[0] == "<" or declared.sizeof() == 1
        return f"{sign}{8 * declared.sizeof()}"
    if isinstance(declared, Bytes):
        return f"{declared.sizeof()}s"
    if isinstance(declared, Array):
        lengths = []
        while isinstance(declared, Array):
            lengths.append(repr(declared.count).removeprefix("this."))
            declared = declared.subcon
        return "*".join([element(declared), *(re.sub(r"\W|this", "", length) for length in lengths)])
    assert isinstance(declared, Const | Default)
    return element(declared.subcon)


def samples_body(index: int, rates: list[list[int]]) -> bytes:
    """Build a SAMPLES body."""
    return build(
        MessageType.SAMPLES, n_axes=len(rates[0]), n_samples=len(rates), session=7, first_index=index,
        device_time_us=index * 4255, status=0, temperature=6272, overrun_count=0, tilt_x=300, tilt_y=-125, rate=rates,
    )  # fmt: skip


def test_the_definition_has_its_hash() -> None:
    """The hash that driver and document carry is the CRC-32C of the definition's text."""
    assert DEFINITION is not None
    text = DEFINITION[1].encode("ascii")
    assert crc32.iscsi(text) == DEFINITION_HASH
    assert f"{DEFINITION_HASH:08X}." in DOCUMENT
    assert text.startswith(b"northfinder native protocol %d\n" % PROTOCOL_VERSION)


def test_every_layout_is_the_definition_s() -> None:
    """Written out again, the declarations give the definition's lines: names, order, types, no more and no fewer."""
    assert DEFINITION is not None
    lines = set(DEFINITION[1].splitlines()[1:])
    declared = {
        f"{code:02x} {code.name} " + " ".join(f"{field.name}:{element(field.subcon)}" for field in layout.subcons)
        for code, layout in LAYOUTS.items()
    }
    assert declared == lines


@pytest.mark.parametrize(("table", "names"), [("code", ErrorCode), ("fault", Fault)])
def test_codes_have_the_document_s_names(table: str, names: type[ErrorCode | Fault]) -> None:
    """Error and fault codes are those of the document's tables."""
    rows = DOCUMENT.split(f"| {table} | name | meaning |\n")[1].split("\n\n")[0]
    found = {int(code): name for code, name in re.findall(r"^\| (\d+) \| (\w+) \|", rows, re.MULTILINE)}
    assert found == {member.value: member.name for member in names}


def test_stage_states_have_the_document_s_names() -> None:
    """The states of STAGE_STATUS are those of its table."""
    row = re.search(r"^\| 1 \| state \| u8 \| (.*) \|$", DOCUMENT, re.MULTILINE)
    assert row is not None
    assert row[1] == ", ".join(f"{code.value} {code.name}" for code in StageCode)


@pytest.mark.parametrize("golden", GOLDEN, ids=lambda golden: golden.name)
def test_golden_frames_are_read(golden: Golden) -> None:
    """A golden frame gives its values, each of them."""
    (body,) = FrameDecoder().feed(golden.frame)
    kind = message_type(body)
    assert kind is not None
    assert kind.name == golden.message
    fields = dict(parse(body))
    fields.pop("_io")
    if kind is MessageType.SAMPLES:
        fields["rate"] = [count for sample in fields["rate"] for count in sample]
    assert fields == golden.values


@pytest.mark.parametrize("golden", GOLDEN, ids=lambda golden: golden.name)
def test_golden_frames_are_written(golden: Golden) -> None:
    """The values give the golden frame, byte for byte."""
    fields: dict[str, Any] = {name: value for name, value in golden.values.items() if name != "type"}
    if "rate" in fields:
        fields["rate"] = np.reshape(fields["rate"], (fields["n_samples"], fields["n_axes"])).tolist()
    assert encode_frame(build(MessageType[golden.message], **fields)) == golden.frame


@pytest.mark.parametrize("golden", [g for g in GOLDEN if g.message == "SAMPLES"], ids=lambda golden: golden.name)
def test_golden_samples_as_arrays(golden: Golden) -> None:
    """The array path gives the same values as the golden frame says."""
    (records,) = decode_samples(FrameDecoder().feed(golden.frame))
    for name, value in golden.values.items():
        assert np.array_equal(records[name].ravel(), np.ravel(np.asarray(value)))
    assert records["rate"].shape == (1, golden.values["n_samples"], golden.values["n_axes"])


def test_rate_keeps_axes_of_a_sample_together() -> None:
    """Sample i of axis j stands at [block, i, j], so that no axis can be taken for another."""
    bodies = [samples_body(0, [[1, 2, 3], [4, 5, 6]]), samples_body(2, [[7, 8, 9], [-1, -2, -3]])]
    (records,) = decode_samples(bodies)
    assert records["rate"].tolist() == [[[1, 2, 3], [4, 5, 6]], [[7, 8, 9], [-1, -2, -3]]]


def test_blocks_of_different_form_stay_in_order() -> None:
    """A shorter last block, or another, begins a new array; order is kept."""
    bodies = [
        samples_body(0, [[1], [2]]),
        samples_body(2, [[3], [4]]),
        samples_body(4, [[5]]),
        samples_body(5, [[6], [7]]),
    ]
    arrays = decode_samples(bodies)
    assert [records["first_index"].tolist() for records in arrays] == [[0, 2], [4], [5]]


@pytest.mark.parametrize("code", sorted(set(MessageType) - {MessageType.SAMPLES}))
def test_only_the_exact_length_is_taken(code: int) -> None:
    """One byte less or more than the layout's length is no message."""
    size = LAYOUTS[MessageType(code)].sizeof()
    body = bytes([code]) + bytes(size)
    assert message_type(body[:size]) is not None
    for wrong in (body[: size - 1], body[: size + 1]):
        assert message_type(wrong) is None
        with pytest.raises(ProtocolError, match=f"type {code:02X} has a body of {len(wrong)} bytes"):
            parse(wrong)


@pytest.mark.parametrize(
    ("n_axes", "n_samples", "size", "good"),
    [
        (1, 119, 512, True),
        (3, 39, 504, True),
        (2, 5, 76, False),
        (1, 0, 36, False),
        (0, 3, 36, False),
        (1, 3, 47, False),
    ],
)
def test_samples_must_have_the_length_they_announce(n_axes: int, n_samples: int, size: int, *, good: bool) -> None:
    """Axes, samples and length of a SAMPLES body must agree, and be possible."""
    body = bytes([0x40, n_axes, n_samples]) + bytes(size - 3)
    assert (message_type(body) is MessageType.SAMPLES) is good


@given(st.binary(min_size=1, max_size=80))
def test_no_body_breaks_the_parser(body: bytes) -> None:
    """Any bytes are a message of their exact length, or a ProtocolError."""
    if message_type(body) is None:
        with pytest.raises(ProtocolError):
            parse(body)
    else:
        assert parse(body).type == body[0]


@settings(deadline=None)
@given(st.data())
def test_a_damaged_line_never_gives_a_wrong_sample(data: st.DataObject) -> None:
    """With a bit flipped, junk put in, and any chunking, only samples that were sent come out, and few are lost."""
    rates = st.integers(-(2**31), 2**31 - 1)
    sent = [
        samples_body(3 * i, data.draw(st.lists(st.lists(rates, min_size=1, max_size=1), min_size=3, max_size=3)))
        for i in range(6)
    ]
    line = bytearray(b"".join(map(encode_frame, sent)))
    bit = data.draw(st.integers(0, 8 * len(line) - 1))
    line[bit // 8] ^= 1 << bit % 8
    place = data.draw(st.integers(0, len(line)))
    line[place:place] = data.draw(st.binary(max_size=8))
    cuts = sorted(data.draw(st.lists(st.integers(0, len(line)), max_size=6)))
    decoder = FrameDecoder()
    chunks = [bytes(line[start:stop]) for start, stop in zip([0, *cuts], [*cuts, len(line)], strict=True)]
    found = [body for chunk in chunks for body in decoder.feed(chunk)]
    assert set(found) <= set(sent)
    assert len(found) >= len(sent) - 4  # two faults, each costs its frame and at most the next


def test_a_layout_that_no_dtype_can_hold_is_refused() -> None:
    """A layout of a form unknown to NumPy is an error in its declaration, not a wrong dtype."""
    with pytest.raises(TypeError, match="no NumPy type"):
        numpy_dtype(Struct("odd" / Const(1, Int8ul), "text" / Struct("inner" / Int8ul)))
