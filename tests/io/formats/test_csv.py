"""Delimited text: layouts, damage, and what must not be guessed."""

import gzip
import io

import numpy as np
import pandas as pd
import pytest

from lmshealth.errors import BadLog
from lmshealth.io import constants
from lmshealth.io.column_map import ColumnMap, CsvLayout
from lmshealth.io.formats import csv as delimited
from lmshealth.io.formats.csv import parse_text
from lmshealth.io.reading import read_log
from lmshealth.io.refusal import Unusable


def parse(text, **layout):
    """Parse text or bytes with a layout."""
    return parse_with(text, ColumnMap(csv=CsvLayout(**layout)))


def parse_with(text, columns):
    """Parse text or bytes by a column map."""
    data = text if isinstance(text, bytes) else text.encode()
    return parse_text(io.BytesIO(data), columns)


def test_leading_lines():
    """Leading lines give metadata; values keep their colons, remarks are passed over."""
    raw = parse("# stage: A\n# remark\n# recorded_at: 2026-01-01T00:00:00Z\ndelta_e_um\n1\n2\n")
    assert raw.metadata == {"stage": "A", "recorded_at": "2026-01-01T00:00:00Z"}
    assert raw.columns["delta_e_um"].tolist() == [1.0, 2.0]


def test_byte_order_mark_and_windows_lines():
    """A byte order mark and Windows line ends change nothing."""
    raw = parse(b"\xef\xbb\xbf# stage: A\r\ndelta_e_um, x\r\n1, a\r\n2, b\r\n")
    assert raw.metadata == {"stage": "A"} and raw.columns["delta_e_um"].tolist() == [1.0, 2.0]


def test_layout():
    """Skipped lines, delimiter and absent header lines are as in the map."""
    raw = parse("vendor \n\ndelta_e_um;b\n1;2\n", skip_rows=2, delimiter=";")
    assert raw.columns["delta_e_um"].tolist() == [1.0]
    raw = parse("1,2\n3,4\n", header=["delta_e_um", "x"])
    assert raw.columns["delta_e_um"].tolist() == [1.0, 3.0]
    numbered = ColumnMap(columns={"delta_e_um": "1"}, csv=CsvLayout(header=False))
    assert parse_with(b"1,2\n3,4\n", numbered).columns["1"].tolist() == [2.0, 4.0]


def test_decimal_commas():
    """Decimal commas are found, stated, and not read where the map states a point."""
    text = "delta_e_um;b\n1,5;x\n-2,25e1;y\n"
    for layout in ({}, {"delimiter": ";"}, {"delimiter": ";", "decimal": ","}):
        assert parse(text, **layout).columns["delta_e_um"].tolist() == [1.5, -22.5]
    with pytest.raises(Unusable, match=r"'1,5' in row 1"):
        parse(text, delimiter=";", decimal=".")


@pytest.mark.parametrize(
    ("text", "reason", "word"),
    [
        ("", "empty", "header"),
        ("# stage: A\n", "empty", "header"),
        ("delta_e_um\n", "empty", "rows"),
        ("delta_e_um,b\n1,2\n3,4,5\n", "corrupt", "row 2 has 3"),
        ("delta_e_um,b\n1,2\n3,4,5,6\n", "corrupt", "row 2 has 4 fields, the first line 2"),
        ("delta_e_um,b\n1,2,9\n3,4,5\n", "corrupt", ""),
        ("delta_e_um,b\n1,2\n3", "corrupt", "1 of 2"),
        ("delta_e_um\n1\noops\n", "columns", "'oops' in row 2"),
        ("delta_e_um,delta_e_um\n1,2\n", "columns", "both be read"),
        ("# stage: A\n# stage: B\ndelta_e_um\n1\n", "metadata", "'A'"),
        (b"delta_e_um\n1\0\n", "corrupt", "NUL"),
        ('delta_e_um\n"1\n2\n', "corrupt", ""),
    ],
)
def test_damage(text, reason, word):
    """Each kind of damage has its reason and its place."""
    with pytest.raises(Unusable) as caught:
        parse(text)
    assert caught.value.reason == reason and word in caught.value.detail


def test_empty_cells_are_missing():
    """An empty cell is a missing sample, not an error."""
    raw = parse("delta_e_um,b\n1,2\n,4\nnan,4\n")
    assert str(raw.columns["delta_e_um"].tolist()) == "[1.0, nan, nan]"


def test_blanks_around_numbers():
    """Blanks change nothing: rows that the quick way cannot read are read the careful way."""
    raw = parse("delta_e_um, b, c\n 1 , 2,  \n 3 ,\t4, 5\n")
    assert raw.columns["delta_e_um"].tolist() == [1.0, 3.0]
    both = ColumnMap(columns={"delta_e_um": "delta_e_um", "acc_c_g": "c"})
    raw = parse_with(b"delta_e_um, c\n1,\n2, 5\n", both)
    assert str(raw.columns["c"].tolist()) == "[nan, 5.0]"


def test_text_beside_numbers():
    """A column that nobody wants may change from numbers to text."""
    rows = "".join(f"{k},{k if k < 200_000 else 'late'}\n" for k in range(200_100))
    assert parse("delta_e_um,note\n" + rows).columns["delta_e_um"][-1] == 200_099.0


@pytest.fixture
def small_blocks(monkeypatch):
    """Read ten rows at a time."""
    monkeypatch.setattr(delimited, "_ROWS", 10)


@pytest.mark.parametrize("place", [0, 9, 10, 11, 20, 34])
@pytest.mark.parametrize("row", ["7,8,9", "7,8,9,10", "7,8,x", "x,8,9"])
def test_long_row_anywhere(small_blocks, place, row):
    """A row with too many fields is found at every place of a block, and named by its number."""
    rows = ["1,2"] * 35
    rows[place] = row
    with pytest.raises(Unusable) as caught:
        parse("delta_e_um,b\n" + "\n".join(rows) + "\n")
    assert caught.value.reason == "corrupt"
    # A fault of the very first row is a warning of pandas, without a number.
    assert place == 0 or f"row {place + 1} has" in caught.value.detail


def test_delimiter_behind_the_last_field(small_blocks):
    """An empty field behind the last, as some exporters write it, is none."""
    raw = parse("delta_e_um,b\n" + "1,2,\n" * 25)
    assert raw.columns["delta_e_um"].tolist() == [1.0] * 25


def test_row_of_a_late_text(small_blocks):
    """The row of a text is counted from the first row, not from its block's."""
    with pytest.raises(Unusable, match="'oops' in row 24"):
        parse("delta_e_um\n" + "1\n" * 23 + "oops\n" + "1\n" * 5)


def test_late_blanks(small_blocks):
    """When a late block needs the careful way, no row comes twice."""
    rows = "".join(f"{k},{k}\n" for k in range(25)) + "25 , 25\n"
    values = parse("delta_e_um,b\n" + rows).columns["delta_e_um"]
    assert values.tolist() == list(range(26))


@pytest.mark.parametrize(
    ("rows", "word"),
    [
        ("1,2\n" * 300_000 + "3", "1 of 2"),
        ("1,2\n" * 300_000 + "\0", f"NUL byte at offset {13 + 1_200_000}"),
        ("1,2\n" * 300_000 + '"1,2\n' + "1,2\n" * 600_000, "quote"),
        ("1,2\n" * 300_000 + "1" * 2_000_000, f"offset {13 + 1_200_000} is longer"),
    ],
)
def test_late_damage(monkeypatch, rows, word):
    """Damage far behind the head is found as the text streams by."""
    monkeypatch.setattr(constants, "LONGEST_BLOCK", 1 << 21)
    monkeypatch.setattr(delimited, "_ROWS", 10_000)
    with pytest.raises(Unusable) as caught:
        parse("delta_e_um,b\n" + rows)
    assert caught.value.reason == "corrupt" and word in caught.value.detail


def test_control_characters_before_the_rows():
    """What was overwritten at its beginning is no table without names."""
    with pytest.raises(Unusable, match="control character 0x13 at offset 4; needed text") as caught:
        parse("M\u00fcl\x13,b\n" + "1,2\n" * 30)
    assert caught.value.reason == "corrupt"


def test_header_without_end():
    """A file that is one long line is not held whole to name its columns."""
    with pytest.raises(Unusable, match="longer than 1048576 bytes"):
        parse("delta_e_um," * 200_000)


@pytest.mark.slow
def test_values_are_those_of_pandas():
    """Blocks change no digit of what pandas reads at once, quick or carefully."""
    values = np.random.default_rng(0).normal(size=(150_000, 2)) * [1e-9, 1e5]
    lines = [f"{one!r},{other!r}\n" for one, other in values.tolist()]
    data = "delta_e_um,acc_x_g\n" + "".join(lines)
    whole = pd.read_csv(io.StringIO(data))
    for content in (data, data.replace("\n", " \n", 3)):
        raw = parse(content)
        for name in whole.columns:
            np.testing.assert_array_equal(raw.columns[name], whole[name].to_numpy())


@pytest.mark.parametrize("name", ["log.txt", "LOG.TSV", "log.dat", "log.txt.gz", "log.tsv.gz"])
def test_names_of_text(make, name):
    """Delimited text is read under the names that exporters give it."""
    data = make("log.csv").read_bytes()
    path = make("log.csv").with_name(name)
    path.write_bytes(gzip.compress(data) if name.endswith(".gz") else data)
    assert len(read_log(path).channels) == 2


TABLE = "time;PE(0);AI 3\n0;1;2\n1;3;5\n2;4;1\n"
MAP = ColumnMap(columns={"delta_e_um": "PE(0)", "acc_x_g": "AI 3"}, sample_rate_hz=1.0)


@pytest.mark.parametrize("before", ["", "Rate 20 kHz\n\n", "Rate;20 kHz\n# stage: A\n", "\n\n"])
@pytest.mark.parametrize("delimiter", [";", ",", "\t", "|"])
def test_names_are_found_below_a_preamble(tmp_path, before, delimiter):
    """Lines before the names need no key of the column map, and neither does the delimiter."""
    (tmp_path / "log.csv").write_text(before + TABLE.replace(";", delimiter))
    log = read_log(tmp_path / "log.csv", columns=MAP)
    assert [channel.values[:].tolist() for channel in log.channels] == [
        [1e-6, 3e-6, 4e-6], pytest.approx([2 * 9.80665, 5 * 9.80665, 9.80665])
    ]  # fmt: skip


def test_names_that_no_line_has_are_refused(tmp_path):
    """The refusal lists what is there, and how the text was read."""
    (tmp_path / "log.csv").write_text(TABLE)
    columns = ColumnMap(columns={"delta_e_um": "PE(1)", "acc_x_g": "AI 5"})
    with pytest.raises(BadLog, match=r"needs AI 5, PE\(1\); there: time, PE\(0\), AI 3; read with"):
        read_log(tmp_path / "log.csv", columns=columns)


@pytest.mark.parametrize("text", ["0,1\n1,2\n", "Rate\n0;1\n1;2\n", "0,5;1\n1,5;2\n"])
def test_a_file_without_names(tmp_path, text):
    """Rows of numbers only: columns are named by their numbers, which the refusal states."""
    (tmp_path / "log.csv").write_text(text)
    with pytest.raises(BadLog, match=r'no line of names \(the columns are "0", "1"'):
        read_log(tmp_path / "log.csv")
    columns = ColumnMap(columns={"delta_e_um": "1"}, sample_rate_hz=1.0)
    log = read_log(tmp_path / "log.csv", columns=columns)
    first = log.refused or log.channels[0].values[:].tolist()[0] > 0
    assert first


def test_stated_marks_hold(tmp_path):
    """A stated delimiter is not replaced by one that would fit better."""
    (tmp_path / "log.csv").write_text(TABLE)
    columns = ColumnMap(columns=MAP.columns, csv=CsvLayout(delimiter=","), sample_rate_hz=1.0)
    with pytest.raises(BadLog, match="needs AI 3"):
        read_log(tmp_path / "log.csv", columns=columns)


def test_empty_lines_are_missing_samples():
    """An empty line has a place in time: a missing sample, but at the end or beside stamps."""
    body = "1\n\n2\n\n\n"
    assert str(parse("delta_e_um\n" + body).columns["delta_e_um"].tolist()) == "[1.0, nan, 2.0]"
    stamped = parse("time_s,delta_e_um\n0,1\n\n1,2\n")
    assert stamped.columns["delta_e_um"].tolist() == [1.0, 2.0]


@pytest.mark.parametrize(
    "end",
    [
        "Rate 1344, overflows 0\n", "Rate 1344, overflows 0", "# end of file\n", "EOF\n",
        "Mean,0.1,0.2\nMaximum,1.0,2.0\n", "\nRecorded by: axis 7\n\n", "Größe;1\n",
    ],
)  # fmt: skip
@pytest.mark.parametrize("n_rows", [3, 40_000])
def test_text_behind_the_rows(tmp_path, end, n_rows):
    """Lines of text behind the last row are no samples, and are counted."""
    rows = "".join(f"{k},{k % 7},{k % 5}\n" for k in range(n_rows))
    (tmp_path / "a.csv").write_text("# sample_rate_hz: 10\nn,acc_x_g,acc_y_g\n" + rows + end)
    log = read_log(tmp_path / "a.csv")
    assert log.channels[0].values.size == n_rows
    assert any("behind the rows" in text for text in log.guessed) == (end != "EOF\n")


@pytest.mark.parametrize("end", ["7,ab\n", "7,1", "oops,1,1,1,1\n1,1,1\n", "7,x,2\n"])
def test_rows_that_are_cut_off_are_no_text(tmp_path, end):
    """A last row without fields, or with a damaged one, is refused."""
    rows = "".join(f"{k},{k % 7},{k % 5}\n" for k in range(9))
    (tmp_path / "a.csv").write_text("# sample_rate_hz: 10\nn,acc_x_g,acc_y_g\n" + rows + end)
    with pytest.raises(BadLog):
        read_log(tmp_path / "a.csv")


@pytest.mark.parametrize(
    ("row", "n_kept"),
    [
        ("5,-6.133e-05", 40),
        ("5,-6.133e-0", 39),
        ("5,-6.133", 39),
        ("5,-", 39),
        ("5,-6.133e-05\n", 40),
    ],
)
def test_a_last_number_that_is_cut_is_left_out(tmp_path, row, n_kept):
    """A row without the end of its line counts where its last number is as long as the others."""
    rows = "".join(f"{k},{(-1) ** k * 1e-4 / (k + 1):.3e}\n" for k in range(39))
    (tmp_path / "a.csv").write_text("# sample_rate_hz: 10\nn,acc_x_m_s2\n" + rows + row)
    log = read_log(tmp_path / "a.csv")
    assert log.channels[0].values.size == n_kept
    assert any("ends inside its last number" in text for text in log.guessed) == (n_kept == 39)


def test_dates_of_two_readings_are_refused_where_it_matters():
    """A single date gives the same times either way; two do, unless a day above 12 shows which."""

    def times(*dates):
        rows = "".join(
            f"{date} 23:59:{k:02d},-0.123456789012\n" for date in dates for k in range(30)
        )
        return parse("time_s,delta_e_um\n" + rows).columns["time_s"][:]

    np.testing.assert_allclose(times("05/01/2026"), np.arange(30), atol=1e-9)
    assert times("12/01/2026", "13/01/2026")[30] == times("12/31/2026", "01/01/2027")[30] == 86400
    for dates in (
        ("05/01/2026", "06/01/2026"),
        ("05-01-2026", "06-01-2026"),
        ("05/01/26", "06/01/26"),
        ("26-01-05", "26-01-06"),
    ):
        np.testing.assert_allclose(times(dates[0]), np.arange(30), atol=1e-9)
        with pytest.raises(Unusable, match=f"{' and '.join(dates)} may begin with the day"):
            times(*dates)
    for dates in (
        ("12-01-2026", "13-01-2026"),
        ("12/30/26", "12/31/26"),
        ("30/12/25", "31/12/25"),
        ("05.01.26", "06.01.26"),
        ("2026-01-05", "2026-01-06"),
    ):
        assert times(*dates)[30] == 86400


def test_other_keys_may_be_given_again():
    """Two lines of a key that no metadata has, as of two sensors, refuse nothing."""
    raw = parse("# sensor: A\n# sensor: B\n# stage: C\ndelta_e_um\n1\n2\n")
    assert raw.metadata["stage"] == "C" and raw.columns["delta_e_um"].size == 2


LONG = "jogging to the start position"


@pytest.mark.parametrize(
    ("names", "row", "later"),
    [
        ("time_ms,acc_x_m_s2,state", "{k},{a},{text}", "A"),
        ("time_ms,acc_x_m_s2,event", "{k},{a},{text}", ""),
        ("state,time_ms,acc_x_m_s2", "{text},{k},{a}", "A"),
        ("time_s,acc_x_m_s2,state", "{k}.25,{a},{text}", "A"),
        ("time_s,acc_x,state\ns,m/s²,-", "{k}.25,{a},{text}", "A"),
    ],
)
@pytest.mark.parametrize("n_long", [2, 30])
def test_rows_with_a_long_text_are_rows(names, row, later, n_long):
    """Rows begin below the names, also where a text in the first ones is longer than numbers."""
    rows = [row.format(k=k, a=k % 7 / 8, text=LONG if k < n_long else later) for k in range(60)]
    raw = parse("\n".join([names, *rows, ""]))
    assert {samples.size for samples in raw.columns.values()} == {60} and len(raw.columns) == 2
    assert raw.guessed == ()
    rows[n_long // 2] = rows[n_long // 2].replace(f"{n_long // 2 % 7 / 8}", "err")
    with pytest.raises(Unusable, match=f"'err' in row {n_long // 2 + 1}"):
        parse("\n".join([names, *rows, ""]))


def test_numbered_channels_are_no_row():
    """A line of numbers that begins with a key belongs to the header, however short the texts."""
    head = "Kanalname\tdelta_e_um\tb\nKanalnummer\t1\t2\n"
    raw = parse(head + "".join(f"\t{k % 7 / 8}\t{k}\n" for k in range(9)))
    assert raw.columns["delta_e_um"].size == 9


@pytest.mark.parametrize("name", ["UTF-16", "utf_16", "utf16", "U16", "utf-16"])
def test_an_encoding_has_several_spellings(name):
    """Every name that Python has for UTF-16 is one."""
    raw = parse("stage\ndelta_e_um\n1\n2\n".encode("utf-16"), encoding=name)
    assert raw.columns["delta_e_um"].tolist() == [1.0, 2.0]


@pytest.mark.parametrize("mark", [".", ","])
def test_a_text_among_times_is_quoted_with_its_row(small_blocks, mark):
    """One text in a column of numbers makes no moments of the others."""
    rows = [f"{k / 8};{k}".replace(".", mark) for k in range(40)]
    rows[25] = "err;25"
    with pytest.raises(Unusable, match="column 'time_s' holds 'err' in row 26"):
        parse("\n".join(["time_s;delta_e_um", *rows, ""]))


@pytest.mark.parametrize("mark", [",", ";", "\t"])
def test_delimiters_that_fill_leading_lines_are_no_text(mark):
    """A spreadsheet saves leading and blank lines with as many delimiters as the rows have."""
    lines = ["# stage: AX-3-Y", "", "# servo_id: k 7", "delta_e_um,a,b", "1,2,3", "2,3,4", ""]
    padded = (line + ",," * (line.startswith("#") or k == 1) for k, line in enumerate(lines))
    raw = parse("\n".join(padded).replace(",", mark))
    assert raw.metadata == {"stage": "AX-3-Y", "servo_id": "k 7"}
