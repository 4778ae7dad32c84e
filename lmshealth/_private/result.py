"""What results show of themselves: a short text, a table, and a figure."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes

_ROWS = 5  # of a digest, at most


class Result:
    """Base of results that people print, export and plot in a session.

    A result has a title and the columns of its table, and of a shorter one to print.
    """

    __slots__ = ()

    # Draws any result: set by `lmshealth`, because drawing is above all results.
    draw: ClassVar[Callable[[Any, str, Any], Any]]

    def title(self) -> str:
        """Return what the result is, in a line."""
        raise NotImplementedError

    def to_columns(self) -> dict[str, Any]:
        """Return the columns of the table of the result, of one length or one value each."""
        raise NotImplementedError

    def digest_columns(self) -> dict[str, Any]:
        """Return the columns of the table that is printed."""
        return self.to_columns()

    def to_frame(self) -> pd.DataFrame:
        """Return the result as a table; units are in the names of its columns, moments in UTC."""
        import pandas as pd

        from lmshealth._private.tables import MOMENTS  # late: --help needs no table

        table = pd.DataFrame(self.to_columns())
        for name in table.columns.intersection(MOMENTS):
            table[name] = pd.to_datetime(table[name], utc=True, format="ISO8601")
        return table

    def plot(self, what: str = "", ax: Axes | None = None) -> Axes:
        """Plot the result, or one mode or parameter of it, in Axes or a new figure."""
        axes: Axes = Result.draw(self, what, ax)
        return axes

    def _digest(self) -> tuple[pd.DataFrame, str]:
        import pandas as pd

        table = pd.DataFrame(self.digest_columns())
        more = len(table) - _ROWS
        return table.head(_ROWS), f"… and {more} more" if more > 0 else ""

    def __repr__(self) -> str:
        table, more = self._digest()
        shown = table.to_string(index=False, float_format="{:.5g}".format, line_width=100_000)
        return "\n".join(filter(None, [self.title(), shown if len(table) else "", more]))

    def _repr_html_(self) -> str:
        from html import escape

        table, more = self._digest()
        shown = table.to_html(index=False, float_format="{:.5g}".format, border=0)
        return f"<p>{escape(self.title())}</p>{shown}<p>{more}</p>"
