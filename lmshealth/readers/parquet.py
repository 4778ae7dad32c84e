"""Parquet: columns, and the key/value metadata of the schema."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from lmshealth.arrays import FloatArray
from lmshealth.readers.columns import ColumnMap
from lmshealth.readers.raw import Format, Raw, check_size, missing_library, not_numeric, wanted
from lmshealth.readers.trouble import Unusable, listed

_MAGIC = b"PAR1"
# Written by the libraries about themselves, nothing the user said about the log.
_LIBRARY_KEYS = frozenset({b"pandas", b"ARROW:schema"})


def _load(path: Path, columns: ColumnMap) -> Raw:
    try:
        import pyarrow.parquet as pq
    except ImportError as error:
        raise missing_library("Parquet", "pyarrow") from error
    # Without pre_buffer the columns are streamed; with it the whole file is held twice.
    with pq.ParquetFile(path, pre_buffer=False, page_checksum_verification=True) as file:
        schema = file.schema_arrow
        names = list(schema.names)
        chosen = wanted(names, columns)
        if twice := sorted({name for name in chosen if names.count(name) > 1}):
            raise Unusable("columns", f"the schema names {listed(twice)} more than once")
        for name in chosen:
            _check_type(name, schema.field(name).type)
        check_size(8 * file.metadata.num_rows * len(chosen), path.stat().st_size)
        table = file.read(columns=chosen, use_threads=False) if chosen else None
        metadata = _text(schema.metadata)
    read = {name: _float64(table.column(name)) for name in chosen} if table is not None else {}
    return Raw(read, metadata, tuple(names))


def _check_type(name: str, kind: Any) -> None:
    import pyarrow as pa

    if not (pa.types.is_integer(kind) or pa.types.is_floating(kind)):
        raise not_numeric(name, f"values of type {kind}")


def _float64(column: Any) -> FloatArray:
    """Convert a column, nulls to NaN, shape ``(n_rows,)``."""
    return np.array(column.to_numpy(), dtype=np.float64)


def _text(metadata: dict[bytes, bytes] | None) -> dict[str, str]:
    return {
        key.decode("utf-8", "replace"): value.decode("utf-8", "replace")
        for key, value in (metadata or {}).items()
        if key not in _LIBRARY_KEYS
    }


PARQUET = Format("Parquet", (".parquet",), lambda head: head.startswith(_MAGIC), _load)
