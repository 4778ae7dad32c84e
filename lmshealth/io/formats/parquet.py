"""Parquet: columns, and the key/value metadata of the schema."""

from pathlib import Path
from typing import Any

from lmshealth.io.buffers import BLOCK, MINUTE, Spool
from lmshealth.io.column_map import ColumnMap, role_of
from lmshealth.io.formats.content import Content, Format, check_size, library, not_numeric, wanted
from lmshealth.io.formats.moments import SinceFirst

_MAGIC = b"PAR1"
# Bytes of each column of the file that are read ahead.
_BUFFER = 1 << 20
# Written by the libraries for themselves.
_LIBRARY_KEYS = frozenset({b"pandas", b"ARROW:schema"})


def _load(path: Path, columns: ColumnMap, max_memory: float) -> Content:
    with library("Parquet", "pyarrow"):
        import pyarrow as pa
        import pyarrow.parquet as pq
    # With pre_buffer, or without a buffer's size, a whole row group is held, which may be the file.
    with pq.ParquetFile(
        path, pre_buffer=False, buffer_size=_BUFFER, page_checksum_verification=True
    ) as file:
        schema, n_rows = file.schema_arrow, file.metadata.num_rows
        chosen = wanted(schema.names, columns)
        times: dict[str, SinceFirst] = {}
        for name in chosen:
            kind: Any = schema.field(name).type
            target = columns.target(name) or ""
            if pa.types.is_timestamp(kind) and role_of(target) == "time":
                times[name] = SinceFirst(columns.signal(target).factor)
            elif not (pa.types.is_integer(kind) or pa.types.is_floating(kind)):
                raise not_numeric(name, f"values of type {kind}")
        check_size(8 * n_rows * len(chosen), path.stat().st_size)
        metadata = {
            key.decode("utf-8", "replace"): value.decode("utf-8", "replace")
            for key, value in (schema.metadata or {}).items()
            if key not in _LIBRARY_KEYS
        }
        # Up to a minute at once, beyond it in blocks; nulls become NaN.
        size = max(1, n_rows) if n_rows <= MINUTE else BLOCK
        batches = file.iter_batches(size, columns=chosen, use_threads=False) if chosen else ()
        taken = {name: Spool(n_rows) for name in chosen}
        for batch in batches:
            for name, spool in taken.items():
                values = batch.column(name).to_numpy(zero_copy_only=False)
                spool.append(times[name](values) if name in times else values)
    read = {name: spool.samples() for name, spool in taken.items()}
    return Content(read, metadata, tuple(schema.names))


PARQUET = Format(
    "Parquet", (".parquet",), lambda head: head.startswith(_MAGIC), _load, library="pyarrow.parquet"
)
