"""Parquet: columns, and the key/value metadata of the schema."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lmshealth.io.buffers import BLOCK, MINUTE, Samples, spools
from lmshealth.io.column_map import ColumnMap
from lmshealth.io.raw import Format, Raw, check_size, missing_library, not_numeric, wanted
from lmshealth.io.refusal import Unusable, listed

_MAGIC = b"PAR1"
# Of each column so many bytes of the file are read ahead.
_BUFFER = 1 << 20
# Written by the libraries about themselves, nothing the user said about the log.
_LIBRARY_KEYS = frozenset({b"pandas", b"ARROW:schema"})


def _load(path: Path, columns: ColumnMap, max_memory: float) -> Raw:
    try:
        import pyarrow.parquet as pq
    except ImportError as error:
        raise missing_library("Parquet", "pyarrow") from error
    # With pre_buffer, or without a buffer's size, a row group is held whole, and one may be all.
    with pq.ParquetFile(
        path, pre_buffer=False, buffer_size=_BUFFER, page_checksum_verification=True
    ) as file:
        schema = file.schema_arrow
        names = list(schema.names)
        chosen = wanted(names, columns)
        if twice := sorted({name for name in chosen if names.count(name) > 1}):
            raise Unusable("columns", f"the schema names {listed(twice)} more than once")
        for name in chosen:
            _check_type(name, schema.field(name).type)
        check_size(8 * file.metadata.num_rows * len(chosen), path.stat().st_size)
        read = _columns(file, chosen) if chosen else {}
        metadata = _text(schema.metadata)
    return Raw(read, metadata, tuple(names))


def _check_type(name: str, kind: Any) -> None:
    import pyarrow as pa

    if not (pa.types.is_integer(kind) or pa.types.is_floating(kind)):
        raise not_numeric(name, f"values of type {kind}")


def _columns(file: Any, chosen: list[str]) -> dict[str, Samples]:
    """Read columns, beyond a minute block by block; nulls as NaN, shape ``(n_rows,)`` each."""
    n_rows = file.metadata.num_rows
    size = max(1, n_rows) if n_rows <= MINUTE else BLOCK
    with spools(chosen) as taken:
        for batch in file.iter_batches(size, columns=chosen, use_threads=False):
            for name, spool in taken.items():
                spool.append(batch.column(name).to_numpy(zero_copy_only=False))
    return {name: spool.samples() for name, spool in taken.items()}


def _text(metadata: dict[bytes, bytes] | None) -> dict[str, str]:
    return {
        key.decode("utf-8", "replace"): value.decode("utf-8", "replace")
        for key, value in (metadata or {}).items()
        if key not in _LIBRARY_KEYS
    }


PARQUET = Format("Parquet", (".parquet",), lambda head: head.startswith(_MAGIC), _load)
