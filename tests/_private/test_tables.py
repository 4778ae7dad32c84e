"""Specification of the tables: names, units and views that agree with each other."""

from __future__ import annotations

from datetime import UTC, date, datetime
from typing import Any

import numpy as np
import pytest

from lmshealth._private.tables import RUN_TABLES, SHARED, TABLES, Column, Table
from lmshealth.report.text import cells, first_field, view_columns
from tests.tools import columns

_SUFFIXES = {
    "_hz": "Hz", "_km": "km", "_um": "µm", "_nm": "nm", "_mm_s": "mm/s", "_mm_s2": "mm/s²",
    "_rad": "rad", "_kg": "kg", "_mm": "mm", "_c": "°C", "_duration_s": "s",
}  # fmt: skip


@pytest.mark.parametrize("name", TABLES)
def test_units_agree_with_the_names_of_their_columns(name: str) -> None:
    """A column whose name ends in a unit has this unit, and every column occurs once."""
    table = TABLES[name]
    assert len(set(table.names)) == len(table.names)
    for column in table.names:
        ends = [unit for suffix, unit in _SUFFIXES.items() if column.endswith(suffix)]
        assert table.units[column] == ends[-1] if ends else column in table.units, column


def test_columns_have_meanings_and_shared_ones_are_used() -> None:
    """Nothing is listed without a meaning, and nothing is shared by fewer than two tables."""
    for table in TABLES.values():
        assert table.rows.endswith(".")
        own = [one for one in (*table.columns, *table.further) if isinstance(one, Column)]
        assert all(one.names and one.meaning for one in own)
        shared = " ".join(one for one in table.columns if isinstance(one, str)).split()
        assert set(shared) <= set(SHARED)
    for name in SHARED:
        assert sum(name in table.names for table in TABLES.values()) > 1, name


@pytest.mark.parametrize("name", TABLES)
def test_views_have_formats(name: str) -> None:
    """Every heading of a view has a value to show, and headings are unique."""
    for view in TABLES[name].shown.values():
        forms = view_columns(view)
        assert len(forms) == view.count("|") + 1
        assert all(first_field(form) for form in forms.values())


def test_the_page_of_all_columns_is_current() -> None:
    """TABLES.md is what the specification makes; `python -m tests.tools.columns` writes it."""
    text = columns.pages()["TABLES.md"]
    assert (columns.REPORT / "TABLES.md").read_text(encoding="utf-8") == text
    for name, table in TABLES.items():
        assert f"**{name}{'.csv' if name in RUN_TABLES else ''}**" in text
        assert all(f"`{column}`" in text for column in table.names)


def test_rows_need_a_value_for_every_column() -> None:
    """A row with too few or too many values is an error; moments become texts."""
    table = Table("one row.", (Column("recorded_at", "moment", "time"), Column("x", "1", "value")))
    assert table.row(datetime(2026, 1, 2, tzinfo=UTC), 3) == {
        "recorded_at": "2026-01-02T00:00:00+00:00",
        "x": 3,
    }
    for values in ((1,), (1, 2, 3)):
        with pytest.raises(ValueError, match=r"zip\(\)"):
            table.row(*values)


def test_rows_are_read_from_attributes() -> None:
    """Known values come before attributes of the same name; a missing attribute is an error."""
    table = Table("one row.", (Column("real imag", "1", "parts"),))
    assert table.rows_of([1 + 2j, 3 + 4j], real=0.0) == [
        {"real": 0.0, "imag": 2.0},
        {"real": 0.0, "imag": 4.0},
    ]
    with pytest.raises(AttributeError):
        table.read("text")


@pytest.mark.parametrize(
    ("form", "row", "shown"),
    [
        ("{x:.2f}", {"x": 1.234}, "1.23"),
        ("{x:number 4}", {"x": 12345.6}, "12 350"),
        ("{x:share 2} ± {y:share 1}", {"x": 0.0123, "y": 0.01}, "1.23 ± 1.0"),
        ("{x:share 2} ± {y:share 1}", {"x": np.nan, "y": 0.01}, "–"),
        ("{x:share 2} ± {y:share 1}", {"x": 0.0123, "y": np.nan}, "1.23 ± –"),
        ("{x:change {y}}", {"x": -0.1, "y": 0.01}, "−9.52 ± 0.90 %"),
        ("{x:yes_or_no}", {"x": False}, "no"),
        ("{x:yes_or_no a b}", {"x": True}, "a"),
        ("{x[1]:travel_left {y}}", {"x": (0.0, np.inf), "y": 2e7}, "beyond 20 000 km"),
        ("{x}", {"x": None}, "–"),
        ("{x}", {"x": date(2026, 1, 2)}, "2026-01-02"),
        ("{x}", {"x": "{y} 3"}, "{y} 3"),
    ],
)
def test_cells_are_formatted_by_their_view(form: str, row: dict[str, Any], shown: str) -> None:
    """Formats of Python and of `text`, with arguments from the row; a missing value is a dash."""
    (found,) = cells({"head": form}, [row])
    assert found["head"].replace("\u202f", " ") == shown


def test_headings_are_replaced_and_left_out() -> None:
    """A heading is replaced, and a column under None is left out."""
    view = "log {log} | loss, N logs {loss:.1f}"
    assert view_columns(view, {"loss, N logs": "loss, 5 logs"}) == {
        "log": "{log}",
        "loss, 5 logs": "{loss:.1f}",
    }
    assert list(view_columns(view, {"log": None})) == ["loss, N logs"]
