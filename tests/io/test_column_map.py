"""Column names and column maps."""

import numpy as np
import pytest

from lmshealth.errors import BadLog, BadTable
from lmshealth.io.column_map import load_columns, parse_column, role_of
from lmshealth.io.reading import read_log
from lmshealth.io.refusal import Unusable, nearest

GOOD = """
sample_rate_hz = 2000
[columns]
delta_e = "PE(0)"
acc_feed_g = "Ch 1"
[units]
delta_e = 4.88e-9
[metadata]
stage = "demo-X"
recorded_at = 2026-03-01T08:30:00Z
baseline = true
[csv]
skip_rows = 1
delimiter = ";"
header = true
[mat]
variable = "log"
"""


def test_map_reads_an_export(tmp_path):
    """A vendor's export is read by its map; columns that only resemble signals are ignored."""
    (tmp_path / "map.toml").write_text(GOOD)
    rows = "".join(f"{i % 7};{(i % 5) / 10};x\n" for i in range(100))
    (tmp_path / "log.csv").write_text("Vendor 3.1\nPE(0);Ch 1;current_limit\n" + rows)
    log = read_log(tmp_path / "log.csv", columns=load_columns(tmp_path / "map.toml"))
    assert log.sample_rate == 2000 and log.metadata.stage == "demo-X" and log.metadata.baseline
    values = {c.name: c.values[:] for c in log.channels}
    assert values["delta_e"].max() == pytest.approx(6 * 4.88e-9)
    assert values["acc_feed"].max() == pytest.approx(0.4 * 9.80665)


def test_map_keeps_columns_of_the_contract(make, tmp_path):
    """Columns that keep the contract are read like the named ones; the map overrides them."""
    (tmp_path / "map.toml").write_text('[columns]\ndelta_e_um = "PE"\n')
    path = make(columns={"PE": np.sin(np.arange(400.0))})
    log = read_log(path, columns=load_columns(tmp_path / "map.toml"))
    values = {c.name: c.values[:] for c in log.channels}
    assert set(values) == {"delta_e", "acc_feed"} and values["delta_e"].max() > 9e-7


def test_absent_source(make, tmp_path):
    """A column that the map names and the file lacks is named, with the columns that are there."""
    (tmp_path / "map.toml").write_text('[columns]\ndelta_e_um = "PE"\n')
    with pytest.raises(BadLog, match="needs PE; there: time_s, delta_e_um") as caught:
        read_log(make(), columns=load_columns(tmp_path / "map.toml"))
    assert caught.value.reason == "columns"
    names = [f"AI {k}" for k in range(200)] + ["PositionError", "PE(0)", "PE(1)"]
    assert nearest(["positionerorr"], names) == "PositionError (most like it, of 203)"
    assert set(nearest(["PE(2)"], names).split(" (most")[0].split(", ")) == {"PE(0)", "PE(1)"}
    assert nearest(["zzzz"], names).endswith("and 191 more")


@pytest.mark.parametrize(
    "text",
    [
        "colums = 1",
        "[columns]\nfoo_um = 'a'",
        "[columns]\ndelta_e = 'a'",
        "[columns]\ndelta_e_um = 'a'\ndelta_e_nm = 'b'",
        "[columns]\ndelta_e_um = 'a'\nacc_x_g = 'a'",
        "[columns]\ndelta_e = 'a'\n[units]\ndelta_e = 'parsec'",
        "[metadata]\ntravel = 3",
        "[metadata]\nstage = ['a']",
        "sample_rate_hz = -1",
        "sample_rate_hz = 1\n[metadata]\nsample_rate_hz = 1",
        "[csv]\ndelimiter = 'ab'",
        "[csv]\ndelimiter = '\"'",
        "[csv]\ndelimiter = '-'",
        "[csv]\nencoding = 'zlib_codec'",
        "[csv]\nencoding = 'idna'",
        "not toml",
    ],
)
def test_bad_maps(tmp_path, text):
    """Slips in a map are errors before any log is read."""
    (tmp_path / "map.toml").write_text(text)
    with pytest.raises(BadTable, match=r"map\.toml"):
        load_columns(tmp_path / "map.toml")


def test_absent_map(tmp_path):
    """A map that is not there is an error that names it."""
    with pytest.raises(BadTable, match="nowhere"):
        load_columns(tmp_path / "nowhere.toml")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "[columns]\nacc_x_g = 'a'\n\n[csv]\ndelimeter = ';'",
            r"csv\.delimeter: unknown key; known are skip_rows, delimiter, decimal, ",
        ),
        ("colums = 1", r"colums: unknown key; known are columns, units, metadata, "),
        ("[csv]\nskip_rows = 'two'", r"csv\.skip_rows: Expected `int | null`, got `str`"),
        ("[columns]\nacc_x_g = 1", r"columns\.acc_x_g: Expected `str`, got"),
        ("sample_rate_hz = 1e300", "sample_rate_hz: needed a number from 1e-06 to 1e.11, got 1e"),
        ("sample_rate_hz = nan", "sample_rate_hz: needed a finite number, got nan"),
        ("[metadata]\ntravel_km = inf", r"metadata\.travel_km: needed a finite number, got inf"),
        ("[columns]\nacc_x = 'a'\n[units]\nacc_x = 1e300", "is given the scale 1e.300; needed"),
        ("[columns]\nacc_x = 'a'\n[units]\nacc_x = 1e-300", "is given the scale 1e-300; needed"),
        ("[csv]\nskip_rows = 10000000", r"csv\.skip_rows: needed a number from 0 to 1e.06, got 1"),
        ("[csv]\nheader = false\n[", "no TOML"),
        (
            "[csv]\ndelimiter = ','\ndecimal = ','",
            "delimiter and decimal are both ','",
        ),
    ],
)
def test_a_mistake_in_a_map_has_line_and_key(tmp_path, text, message):
    """As in a stage description, and never in the words of a library."""
    (tmp_path / "map.toml").write_text(text)
    with pytest.raises(BadTable, match=message) as error:
        load_columns(tmp_path / "map.toml")
    assert "$" not in str(error.value)


@pytest.mark.parametrize(
    ("column", "name", "role", "factor"),
    [
        ("delta_e_um", "delta_e", "displacement", 1e-6),
        ("delta_e_nm", "delta_e", "displacement", 1e-9),
        ("delta_e_x_mm", "delta_e_x", "displacement", 1e-3),
        ("acc_feed_m_s2", "acc_feed", "acceleration", 1.0),
        ("acc_feed_mm_s2", "acc_feed", "acceleration", 1e-3),
        ("acc_x_g", "acc_x", "acceleration", 9.80665),
        ("current_ma", "current", "current", 1e-3),
        ("current_q_a", "current_q", "current", 1.0),
        ("reference_position_mm", "reference_position", "reference_position", 1e-3),
        ("reference_velocity_m_s", "reference_velocity", "reference_velocity", 1.0),
        ("time_s", "time", "time", 1.0),
    ],
)
def test_contract_names(column, name, role, factor):
    """The longest unit wins and gives the factor to SI."""
    signal = parse_column(column)
    assert (signal.name, signal.role, signal.factor) == (name, role, factor)


@pytest.mark.parametrize("column", ["delta_e", "delta_e_inch", "acc_x", "acc_x_m_s", "current_mm"])
def test_unknown_units(column):
    """An absent unit, an unknown one and one of another quantity are errors."""
    with pytest.raises(Unusable, match="needed one of"):
        parse_column(column)


@pytest.mark.parametrize("column", ["accuracy", "delta_energy", "time_of_day", "position_mm"])
def test_no_signal(column):
    """A name that only resembles a signal's is none."""
    assert role_of(column) is None


@pytest.mark.parametrize(("unit", "factor"), [("m/s²", 1.0), ("g", 9.80665), (0.01, 0.01)])
def test_given_units(unit, factor):
    """A column map may give a unit or the SI value of one count."""
    assert parse_column("acc_x", unit).factor == factor


@pytest.mark.parametrize(("column", "unit"), [("acc_x_g", "g"), ("acc_x", "um"), ("acc_x", 0.0)])
def test_contradicting_units(column, unit):
    """A unit given twice, of another quantity or a scale of 0 are errors."""
    with pytest.raises(Unusable):
        parse_column(column, unit)
