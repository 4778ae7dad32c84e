"""Writing recordings as CSV, Parquet and HDF5 in the log contract."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import h5py
import numpy as np
import pandas as pd

from models.errors import BadParameter, ModelError, OccupiedFolder, UnknownFormat
from models.recordings.recording import Recording

_CHUNK = 1 << 16


def _write_csv(recording: Recording, path: Path) -> None:
    """Write `# key: value` lines, a header and the shortest decimals that round-trip float32."""
    with path.open("w", encoding="utf-8", newline="") as stream:
        for key, value in recording.metadata.items():
            stream.write(f"# {key}: {value}\n")
        table = pd.DataFrame(recording.columns)
        table.to_csv(stream, index=False, lineterminator="\n")


def _write_parquet(recording: Recording, path: Path) -> None:
    """Write columns and schema metadata; byte-stream split suits noise-like floats."""
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError as error:
        raise ModelError("writing parquet needs pyarrow: install it, or use hdf5") from error
    metadata = {key: str(value) for key, value in recording.metadata.items()}
    table = pa.table(dict(recording.columns)).replace_schema_metadata(metadata)
    pq.write_table(
        table,
        path,
        use_dictionary=False,
        column_encoding=dict.fromkeys(recording.columns, "BYTE_STREAM_SPLIT"),
        compression="zstd",
        compression_level=1,
    )


def _write_hdf5(recording: Recording, path: Path) -> None:
    """Write one chunked dataset per column and root attributes."""
    with h5py.File(path, "w") as file:
        for key, value in recording.metadata.items():
            file.attrs[key] = value
        for name, values in recording.columns.items():
            constant = bool(np.all(values == values[0]))
            file.create_dataset(
                name,
                data=values,
                chunks=(min(_CHUNK, values.size),),
                shuffle=True,
                # Noise hardly shrinks; only a constant column is worth the time.
                compression="gzip" if constant else None,
                compression_opts=1 if constant else None,
            )


WRITERS: dict[str, tuple[str, Callable[[Recording, Path], None]]] = {
    "csv": (".csv", _write_csv),
    "parquet": (".parquet", _write_parquet),
    "hdf5": (".h5", _write_hdf5),
}


def file_suffix(file_format: str) -> str:
    """Return the file suffix of a format.

    Raises
    ------
    UnknownFormat
        If no writer is registered under the name.
    """
    if file_format not in WRITERS:
        raise UnknownFormat(file_format, WRITERS)
    return WRITERS[file_format][0]


def format_of(path: Path, wanted: str | None = None) -> str:
    """Return the format of a file's suffix.

    Parameters
    ----------
    wanted
        Format that the suffix must not contradict.

    Raises
    ------
    BadParameter
        If no log has such a suffix, or the wanted format has another.
    UnknownFormat
        If no writer is registered under the wanted name.
    """
    suffixes = {file_suffix(name): name for name in WRITERS if wanted in (None, name)}
    if wanted is not None and not suffixes:
        raise UnknownFormat(wanted, WRITERS)
    if path.suffix not in suffixes:
        chosen = "" if wanted is None else f", the suffix of {wanted}"
        raise BadParameter("out", path.name, f"a name ending in {' or '.join(suffixes)}{chosen}")
    return suffixes[path.suffix]


def refuse_other_logs(folder: Path, names: Iterable[str]) -> None:
    """Reject a folder where simulated logs of other names would stay next to a new manifest.

    Raises
    ------
    OccupiedFolder
        If there is one that is not among the names.
    """
    others = {p.name for kind in ("log", "velocity") for p in folder.glob(f"{kind}-*.*")}
    others -= set(names)
    if others:
        raise OccupiedFolder(str(folder), min(others), len(others))


def write_log(recording: Recording, path: Path, file_format: str) -> None:
    """Write a recording; a file appears under its name only when it is complete."""
    suffix = file_suffix(file_format)
    # The partial file has no registered log suffix: a reader of the folder passes it by.
    partial = path.with_name(f".{path.name}.partial")
    WRITERS[file_format][1](recording, partial)
    partial.replace(path.with_suffix(suffix))
