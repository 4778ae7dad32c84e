"""Delimited text: layouts, damage, and what must not be guessed."""

import pytest

from lmshealth.readers.columns import ColumnMap, CsvLayout
from lmshealth.readers.delimited import parse_text
from lmshealth.readers.trouble import Unusable


def parse(text, **layout):
    """Parse text or bytes with a layout."""
    data = text if isinstance(text, bytes) else text.encode()
    return parse_text(data, ColumnMap(csv=CsvLayout(**layout)))


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
    """Skipped lines, delimiter and absent header lines are as the map says."""
    raw = parse("vendor \n\ndelta_e_um;b\n1;2\n", skip_rows=2, delimiter=";")
    assert raw.columns["delta_e_um"].tolist() == [1.0]
    raw = parse("1,2\n3,4\n", header=["delta_e_um", "x"])
    assert raw.columns["delta_e_um"].tolist() == [1.0, 3.0]
    numbered = ColumnMap(columns={"delta_e_um": "1"}, csv=CsvLayout(header=False))
    assert parse_text(b"1,2\n3,4\n", numbered).columns["1"].tolist() == [2.0, 4.0]


@pytest.mark.parametrize(
    ("text", "reason", "word"),
    [
        ("", "empty", "header"),
        ("# stage: A\n", "empty", "header"),
        ("delta_e_um\n", "empty", "rows"),
        ("delta_e_um,b\n1,2\n3,4,5\n", "corrupt", "3"),
        ("delta_e_um,b\n1,2,9\n3,4,5\n", "corrupt", ""),
        ("delta_e_um,b\n1,2\n3", "corrupt", "1 of 2"),
        ("delta_e_um\n1\noops\n", "columns", "'oops' in row 2"),
        ("delta_e_um,delta_e_um\n1,2\n", "columns", "more than once"),
        ("# stage: A\n# stage: B\ndelta_e_um\n1\n", "metadata", "'A'"),
        (b"delta_e_um\n1\0\n", "corrupt", "NUL"),
        (b"delta_e_\xb5m\n1\n", "corrupt", "0xb5"),
        ('delta_e_um\n"1\n2\n', "corrupt", ""),
    ],
)
def test_damage(text, reason, word):
    """Each kind of damage has its reason and says where it is."""
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
    raw = parse_text(b"delta_e_um, c\n1,\n2, 5\n", both)
    assert str(raw.columns["c"].tolist()) == "[nan, 5.0]"


def test_text_beside_numbers():
    """A column that nobody wants may change from numbers to text."""
    rows = "".join(f"{k},{k if k < 200_000 else 'late'}\n" for k in range(200_100))
    assert parse("delta_e_um,note\n" + rows).columns["delta_e_um"][-1] == 200_099.0
