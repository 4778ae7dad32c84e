"""Pages as PDF (WeasyPrint)."""

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
    """A PDF cannot be made; its HTML page exists."""


def write_pdfs(pages: Iterable[Path]) -> list[Path]:
    """Write a PDF next to each page, under the same name.

    The bytes are reproducible, and nothing is loaded from the network or other files.

    Raises
    ------
    PdfError
        If WeasyPrint is missing or cannot lay out a page.
    """
    html, fetcher = _library()
    templates = resources.files("lmshealth") / "report" / "templates"
    style = (templates / "pdf.css").read_text(encoding="utf-8")
    written = []
    for page in pages:
        text = page.read_text(encoding="utf-8").replace("</style>", f"{style}</style>", 1)
        text = give_letters(text)
        # WeasyPrint does not resolve CSS variables inside SVG.
        text = re.sub(r"var\(--\w+, (#\w+)\)", r"\1", text)
        target = page.with_suffix(".pdf")
        try:
            content = html(string=text, url_fetcher=fetcher).write_pdf()
        except Exception as error:  # any failure: the HTML page exists
            found = f"cannot be made: {type(error).__name__} {error}"
            raise PdfError(f"{target}: {found}; print {page} from a browser instead") from error
        write_bytes(target, content)
        written.append(target)
    return written


def _library() -> tuple[Any, Any]:
    """Import WeasyPrint, with a fetcher that allows nothing outside of a page."""
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
            "WeasyPrint does not find its libraries; install libpangoft2-1.0-0 and "
            f"libharfbuzz-subset0 (Debian); the pages are written ({error})"
        ) from error
    return HTML, URLFetcher(allowed_protocols=("data",))
