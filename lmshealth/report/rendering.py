"""Rendering: templates to HTML pages (Jinja2, everything escaped), pages to PDF (WeasyPrint)."""

import hashlib
import inspect
import io
import os
import re
import warnings
from base64 import b64encode
from collections.abc import Iterable
from contextlib import redirect_stdout, suppress
from functools import cache
from importlib import metadata, resources
from pathlib import Path
from typing import Any

from markupsafe import Markup

from lmshealth._private.files import write_bytes
from lmshealth._private.tables import TABLES
from lmshealth.errors import LmshealthError
from lmshealth.io.manifest import NOT_LOGS
from lmshealth.report import constants, language, text


def render(template: str, /, **content: Any) -> str:
    """Render a template with the values of its names."""
    return str(_environment().get_template(template).render(content))


def read(name: str) -> str:
    """Return the text of a style sheet or script beside the templates."""
    folder = resources.files("lmshealth") / "report" / "templates"
    return (folder / name).read_text(encoding="utf-8")


def sha256(script: str) -> str:
    """Return the hash of a script for the content security policy of its page."""
    return b64encode(hashlib.sha256(script.encode()).digest()).decode()


def place(value: float, length: float) -> float:
    """Return the position of a value on a bar, in % of the bar's length."""
    return round(100 * min(max(value, 0.0) / length, 1.0), 2)


@cache
def _environment() -> Any:
    """Load the templates, which are compiled once: parsing takes longer than rendering."""
    import jinja2

    class Compiled(jinja2.FileSystemBytecodeCache):
        """Compiled templates in a folder of temporary files that only the user may write to."""

        def dump_bytecode(self, bucket: Any) -> None:
            with suppress(OSError):  # a full disk
                super().dump_bytecode(bucket)

    version = metadata.version("lmshealth")
    try:
        pattern = f"__lmshealth_{version}-{jinja2.__version__}_%s.cache"
        compiled: Any = Compiled(pattern=pattern)
    except (OSError, RuntimeError):  # no such folder
        compiled = None
    pages = jinja2.Environment(
        loader=jinja2.PackageLoader("lmshealth.report", "templates"),
        autoescape=True,
        bytecode_cache=compiled,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    pages.filters |= dict(inspect.getmembers(text, inspect.isfunction))
    pages.filters |= {"place": place, "sha256": sha256, "translated_svg": translated_svg}
    pages.filters |= {name: getattr(language, name) for name in ("sentence", "is_known", "label")}
    pages.globals |= {"covariate": text.covariate, "constants": constants, "tables": TABLES}
    pages.globals |= {"language": language.language, "_": _translated, "_n": _counted}
    pages.globals |= {"version": version, "not_logs": NOT_LOGS}
    return pages


def _translated(message: str, /, **values: Any) -> Any:
    """Translate a message of a template, which may have marks of HTML; its values are escaped."""
    return Markup(language.tr(message)).format(**values)  # noqa: S704


def _counted(one: str, many: str, n: int, /, **values: Any) -> Any:
    """Translate a message of a template by number, as `_translated` does."""
    return Markup(language.tr_either(one, many, n)).format(n=n, **values)  # noqa: S704


def translated_svg(svg: Any) -> Any:
    """Translate the labels of a figure (Markup) that was drawn in English."""
    label = language.label
    return Markup(re.sub(r">([^<>]+)</text>", lambda found: f">{label(found[1])}</text>", svg))  # noqa: S704


class PdfError(LmshealthError):
    """A PDF cannot be made; its HTML page exists."""


def write_pdfs(pages: Iterable[Path]) -> list[Path]:
    """Write a PDF next to each page, under the same name.

    The bytes are reproducible, and nothing is loaded from the network or other files. `PdfError` if
    WeasyPrint is missing or cannot lay out a page.
    """
    from unittest.mock import patch  # late: only this needs it

    html, fetcher = load_pdf_library()
    style, written = read("pdf.css"), []
    # Of fonts by fontTools, which WeasyPrint uses without HarfBuzz-Subset.
    time = {"SOURCE_DATE_EPOCH": os.environ.get("SOURCE_DATE_EPOCH") or "0"}
    for page in pages:
        source = page.read_text(encoding="utf-8").replace("</style>", f"{style}</style>", 1)
        # WeasyPrint does not resolve CSS variables inside SVG.
        source = re.sub(r"var\(--\w+, (#\w+)\)", r"\1", source)
        target = page.with_suffix(".pdf")
        try:
            with patch.dict(os.environ, time):
                content = html(string=source, url_fetcher=fetcher).write_pdf()
        except Exception as error:  # any failure: the HTML page exists
            found = f"cannot be made: {type(error).__name__} {error}"
            raise PdfError(f"{target}: {found}; print {page} from a browser instead") from error
        write_bytes(target, content)
        written.append(target)
    return written


def load_pdf_library() -> tuple[Any, Any]:
    """Import WeasyPrint, with a fetcher that allows nothing outside of a page.

    `PdfError` names what to install where it, or a library of the system that it needs, is missing.
    """
    try:
        # It works without HarfBuzz-Subset, but announces that a later version will not.
        with warnings.catch_warnings(), redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore", DeprecationWarning)
            from weasyprint import HTML
            from weasyprint.urls import URLFetcher
    except ImportError as error:
        raise PdfError(
            'PDFs need WeasyPrint: pip install "lmshealth[pdf]"; the pages are written, and '
            "`lmshealth report --pdf` makes PDFs of what the store keeps"
        ) from error
    except OSError as error:
        raise PdfError(
            "PDFs need libraries of the system, which WeasyPrint does not find; install "
            "libpangoft2-1.0-0 and libharfbuzz-subset0 (Debian, Ubuntu) or pango (Homebrew, MSYS2)"
            f"; the pages are written ({str(error).partition('.  ')[0]})"
        ) from error
    return HTML, URLFetcher(allowed_protocols=("data",))
