"""Moments and ticks in columns of times, in every format that has them."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from lmshealth._private.toml import decode
from lmshealth.errors import BadLog
from lmshealth.io.column_map import ColumnMap
from lmshealth.io.formats.content import SinceFirst
from lmshealth.io.reading import read_log
from lmshealth.stage.proposal import propose

NOISE = np.random.default_rng(0).normal(size=2000)
BEGIN = np.datetime64("2026-01-05T08:00:00", "us")
STAMPS = BEGIN + np.arange(2000) * np.timedelta64(2500, "us")


@pytest.mark.parametrize("zone", [None, "UTC"])
def test_moments_of_parquet(tmp_path: Path, zone: str | None) -> None:
    """A column of time stamps is mapped to any unit, and proposed; it is no signal."""
    path = tmp_path / "a.parquet"
    moments = pa.array(STAMPS, pa.timestamp("us", zone))
    pq.write_table(pa.table({"when": moments, "acc_x_g": NOISE}), path)
    for target in ("time_s", "time_us"):
        columns = ColumnMap(columns={target: "when"})
        assert read_log(path, columns=columns).sample_rate == pytest.approx(400.0)
    text, _ = propose(path)
    log = read_log(path, columns=decode(text.encode(), ColumnMap))
    assert log.sample_rate == pytest.approx(400.0) and log.channels[0].name == "acc_x"
    with pytest.raises(BadLog, match="one number per sample"):
        read_log(path, columns=ColumnMap(columns={"acc_y_g": "when"}))


@pytest.mark.parametrize(
    ("name", "ticks"), [("time_s", "ns"), ("time_ms", "us"), ("time_us", "ns")]
)
def test_ticks_of_hdf5(tmp_path: Path, name: str, ticks: str) -> None:
    """Ticks since an epoch are read in any format, and date the log."""
    with h5py.File(tmp_path / "a.h5", "w") as file:
        stamps = BEGIN + np.arange(2000) * np.timedelta64(3000, "us")
        file[name] = stamps.astype(f"datetime64[{ticks}]").astype(np.int64)
        file["acc_x_g"] = NOISE
    log = read_log(tmp_path / "a.h5")
    assert log.sample_rate == pytest.approx(1000 / 3)
    assert log.metadata.recorded_at is not None
    assert log.metadata.recorded_at.isoformat() == "2026-01-05T08:00:00+00:00"


def test_moments_that_are_missing() -> None:
    """What is no moment has no time; blocks without any wait for the first."""
    since = SinceFirst("time_ms", ColumnMap())
    assert np.isnan(since(np.array(["NaT", "NaT"], "M8[us]"))).all()
    read = since(np.array([STAMPS[1], "NaT", STAMPS[0]], "M8[us]"))
    np.testing.assert_allclose(read, [2.5, np.nan, 0.0])
    np.testing.assert_allclose(since(STAMPS[2:4]), [5.0, 7.5])
