"""Report pages as PDFs, to be sent and filed."""

from __future__ import annotations

import re
from collections.abc import Iterable
from importlib import resources
from pathlib import Path
from typing import Any

from lmshealth._files import write_bytes
from lmshealth.errors import LmshealthError
from lmshealth.report.svg import give_letters


class PdfError(LmshealthError):
    """A PDF that cannot be made; the page it would be made of is there."""


def write_pdfs(pages: Iterable[Path]) -> list[Path]:
    """Write a PDF beside each page, under the same name.

    The same page gives the same bytes, whatever the time. Nothing is loaded from anywhere.

    Parameters
    ----------
    pages : iterable of Path
        HTML files that `write_report` wrote.

    Raises
    ------
    PdfError
        If the library for it is not there, or cannot lay out a page.
    """
    html, fetcher = _library()
    style = (resources.files("lmshealth") / "report" / "templates" / "pdf.css").read_text(
        encoding="utf-8"
    )
    written = []
    for page in pages:
        text = page.read_text(encoding="utf-8").replace("</style>", f"{style}</style>", 1)
        text = give_letters(text)
        # Pictures name colours of the style sheet, which are not looked up inside of them.
        text = re.sub(r"var\(--\w+, (#\w+)\)", r"\1", text)
        target = page.with_suffix(".pdf")
        try:
            content = html(string=text, url_fetcher=fetcher).write_pdf()
        except Exception as error:  # whatever it stumbles over, the page is there
            raise PdfError(
                f"{target}: cannot be made: {type(error).__name__} {error}; print {page} from a "
                "browser instead"
            ) from error
        write_bytes(target, content)
        written.append(target)
    return written


def _library() -> tuple[Any, Any]:
    """Load WeasyPrint, and a fetcher that reads nothing outside of a page."""
    try:
        from weasyprint import HTML
        from weasyprint.urls import URLFetcher
    except ImportError as error:
        raise PdfError(
            'PDFs need WeasyPrint: pip install "lmshealth[pdf]"; the pages are written, and '
            "`lmshealth report --pdf` makes PDFs of what the store keeps"
        ) from error
    except OSError as error:
        raise PdfError(
            "WeasyPrint does not find its libraries; Debian has them in libpangoft2-1.0-0 and "
            f"libharfbuzz-subset0; the pages are written ({error})"
        ) from error
    return HTML, URLFetcher(allowed_protocols=("data",))
