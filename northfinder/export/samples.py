"""The samples of a record as a table, a few ten thousand rows at a time.

=========================  ===========================================================================================
``stream``                 number of the gyro's stream; a measurement that was resumed has several
``sample_index``           counts every sample since the start of the stream
``device_time_s``          gyro's clock at the sample: that of its block, and sample periods since
``counts_1`` …             as the gyro sent them, int32 or float32, one column an axis
``rate_1_rad_s`` …         the same times the weight of a count, exactly as the estimator has it
``temperature_degc``       of the block; likewise ``tilt_x_rad``, ``tilt_y_rad`` and ``specific_force_x_m_s2`` …
``status``                 bits of the gyro's status, docs/record.md
``step``                   number of the step whose dwell the sample belongs to, -1 if to none
``stage_azimuth_rad``      measured in that dwell; likewise ``stage_elevation_rad``
=========================  ===========================================================================================

What was not measured is nan.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from northfinder.errors import RecordError
from northfinder.record import DwellSpan, Record
from northfinder.record.block_columns import BlockColumns

Column = NDArray[np.generic]
#: Blocks in a batch.
_BLOCKS = 512


def sample_batches(record: Record) -> Iterator[dict[str, Column]]:
    """Yield the samples of `record` in order, as columns of equal length by name. Raises RecordError."""
    spans, rates, form = record.steps(), _sample_rates(record), None
    for stream, columns in record.column_batches(_BLOCKS):
        if stream not in rates:
            raise RecordError(f"the record {record.path} does not say the sample rate of stream {stream}")
        if form is not None and form != (columns.counts.shape[1], columns.counts.dtype):
            raise RecordError(f"the record {record.path} holds samples of several forms: no table can hold them")
        form = (columns.counts.shape[1], columns.counts.dtype)
        yield _batch(stream, columns, rates[stream], [span for span in spans if span.stream == stream])


def _sample_rates(record: Record) -> dict[int, float]:
    """Return the sample rate of each stream, Hz."""
    return {info.stream: info.sample_rate for info in record.streams()}


def _batch(stream: int, columns: BlockColumns, sample_rate: float, spans: Sequence[DwellSpan]) -> dict[str, Column]:
    length = columns.n_samples
    within = np.arange(length.sum()) - np.repeat(np.cumsum(length) - length, length)
    index = np.repeat(columns.first_index, length) + within
    rate = columns.rate
    axes = range(rate.shape[1])
    return {
        "stream": np.full(index.size, stream, dtype=np.int32),
        "sample_index": index,
        "device_time_s": np.repeat(columns.device_time, length) + within / sample_rate,
        **{f"counts_{axis + 1}": columns.counts[:, axis] for axis in axes},
        **{f"rate_{axis + 1}_rad_s": rate[:, axis] for axis in axes},
        "temperature_degc": np.repeat(columns.temperature, length),
        **{f"tilt_{name}_rad": np.repeat(columns.tilt[:, i], length) for i, name in enumerate("xy")},
        **{
            f"specific_force_{name}_m_s2": np.repeat(columns.specific_force[:, i], length)
            for i, name in enumerate("xyz")
        },
        "status": np.repeat(columns.status, length).astype(np.int32),
        **_of_dwells(index, spans),
    }


def _of_dwells(index: NDArray[np.int64], spans: Sequence[DwellSpan]) -> dict[str, Column]:
    """Return for each sample which dwell it belongs to and where the stage stood."""
    step = np.full(index.size, -1, dtype=np.int32)
    azimuth, elevation = np.full(index.size, np.nan), np.full(index.size, np.nan)
    for span in spans:
        first, stop = np.searchsorted(index, [span.first_index, span.stop_index])
        step[first:stop] = span.step
        azimuth[first:stop], elevation[first:stop] = span.measured_azimuth, span.measured_elevation
    return {"step": step, "stage_azimuth_rad": azimuth, "stage_elevation_rad": elevation}


def step_table(record: Record) -> dict[str, Column]:
    """Return the finished dwells of `record` as columns by name."""
    spans = record.steps()
    units = {"azimuth": "_rad", "elevation": "_rad", "measured_azimuth": "_rad", "measured_elevation": "_rad"}
    units |= {"dwell": "_s", "stream_start": "_s", "sample_rate": "_hz"}
    names = ("name", *units, "first_index", "stop_index", "stream", "turn_on")
    table = {f"step_{name}{units.get(name, '')}": np.array([getattr(span, name) for span in spans]) for name in names}
    return {"step_number": np.array([span.step for span in spans])} | table
