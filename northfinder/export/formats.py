"""Samples to CSV, Parquet, NPZ and MAT-files, in pieces: memory does not grow with the record."""

from __future__ import annotations

import tempfile
import zipfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, BinaryIO

import msgspec
import numpy as np

from northfinder.errors import RecordError
from northfinder.export.mat import write_array, write_header, write_text
from northfinder.export.samples import Column, sample_batches, step_table
from northfinder.record import Record
from northfinder.record.files import new_file

#: Bytes copied at a time.
_PIECE = 1 << 20


def export_record(record: Record, out: Path, kind: str) -> int:
    """Write the samples of `record` to a new file `out` of a `kind` of FORMATS; return how many there are.

    Raises RecordError if `out` exists or cannot be written, or the record is damaged; nothing is left behind then.
    """
    with new_file(out) as part:
        return FORMATS[kind](record, part)


def about(record: Record) -> str:
    """Return what goes with the samples: plan, devices, assumptions and fix, as JSON."""
    keys = ("northfinder", "plan", "identities", "assumptions", "config", "simulation")
    facts: dict[str, Any] = {key: record.meta(key) for key in keys}
    return msgspec.json.encode(facts | {"fixes": record.fixes(), "events": record.events()}).decode()


def _batches(record: Record) -> Iterator[dict[str, Column]]:
    """Yield the batches. Raises RecordError if there are none."""
    empty = True
    for batch in sample_batches(record):
        empty = False
        yield batch
    if empty:
        raise RecordError(f"the record {record.path} holds no samples")


def _csv(record: Record, out: Path) -> int:
    from pyarrow import csv  # noqa: PLC0415  # dear to import

    options = csv.WriteOptions(quoting_style="none")
    with out.open("wb") as file:  # Arrow knows no names but Unicode
        return _arrow(record, lambda schema: csv.CSVWriter(file, schema, write_options=options))


def _parquet(record: Record, out: Path) -> int:
    from pyarrow import parquet  # noqa: PLC0415  # dear to import

    kept = {"northfinder": about(record)}
    with out.open("wb") as file:
        return _arrow(record, lambda schema: parquet.ParquetWriter(file, schema.with_metadata(kept)), kept)


def _arrow(record: Record, writer_of: Callable[[Any], Any], metadata: dict[str, str] | None = None) -> int:
    """Write record batches; what was not measured is null."""
    import pyarrow as pa  # noqa: PLC0415  # dear to import

    n_samples = 0
    with ExitStack() as stack:
        writer = None
        for batch in _batches(record):
            arrays = {name: pa.array(column, from_pandas=True) for name, column in batch.items()}
            rows = pa.RecordBatch.from_pydict(arrays, metadata=metadata)
            if writer is None:
                writer = stack.enter_context(writer_of(rows.schema))
            writer.write_batch(rows)
            n_samples += rows.num_rows
    return n_samples


class _Columns:
    """The columns of a record, each in a temporary file of its own."""

    def __init__(self, record: Record, folder: Path) -> None:
        """Write them. Raises RecordError."""
        self.dtypes: dict[str, np.dtype[np.generic]] = {}
        self.n = 0
        self._folder = folder
        with ExitStack() as stack:
            files: dict[str, BinaryIO] = {}
            for batch in _batches(record):
                for name, column in batch.items():
                    if name not in files:
                        files[name] = stack.enter_context((folder / name).open("wb"))
                        self.dtypes[name] = column.dtype
                    files[name].write(np.ascontiguousarray(column).tobytes())
                self.n += len(batch["stream"])

    def pieces(self, name: str) -> Iterator[bytes]:
        """Yield the bytes of a column."""
        with (self._folder / name).open("rb") as file:
            while piece := file.read(_PIECE):
                yield piece


def _npz(record: Record, out: Path) -> int:
    with tempfile.TemporaryDirectory(dir=out.parent) as folder, zipfile.ZipFile(out, "w") as archive:
        columns = _Columns(record, Path(folder))
        for name, dtype in columns.dtypes.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                header = {"descr": dtype.str, "fortran_order": False, "shape": (columns.n,)}
                np.lib.format.write_array_header_1_0(entry, header)
                for piece in columns.pieces(name):
                    entry.write(piece)
        for name, array in (*step_table(record).items(), ("about_json", np.array(about(record)))):
            with archive.open(f"{name}.npy", "w") as entry:
                np.lib.format.write_array(entry, array, allow_pickle=False)
    return columns.n


def _mat(record: Record, out: Path) -> int:
    with tempfile.TemporaryDirectory(dir=out.parent) as folder, out.open("wb") as file:
        columns = _Columns(record, Path(folder))
        write_header(file)
        for name, dtype in columns.dtypes.items():
            write_array(file, name, dtype, columns.n, columns.pieces(name))
        for name, array in step_table(record).items():
            if array.dtype.kind == "U":
                write_text(file, name, array.tolist())
            else:
                write_array(file, name, array.dtype, len(array), [array.tobytes()])
        write_text(file, "about_json", [about(record)])
    return columns.n


#: How each kind of file is written.
FORMATS: dict[str, Callable[[Record, Path], int]] = {"csv": _csv, "parquet": _parquet, "npz": _npz, "mat": _mat}
