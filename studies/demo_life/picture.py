"""Take the README's picture: the first screen of the report that `make demo` wrote.

Needs Debian's chromium and the demo's result; run it after `make demo`.
"""

from __future__ import annotations

import shutil
from pathlib import Path

from PIL import Image
from playwright.sync_api import sync_playwright

HERE = Path(__file__).parent
PAGES = HERE.parents[1] / "demo" / "result"


def main() -> None:
    """Write report.png in few colours, so that it stays small."""
    page_path = next(path for path in sorted(PAGES.glob("*.html")) if path.name != "index.html")
    target = HERE / "report.png"
    with sync_playwright() as play:
        browser = play.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--no-sandbox"]
        )
        page = browser.new_page(viewport={"width": 1120, "height": 690})
        page.goto(page_path.as_uri())
        page.screenshot(path=target)
        browser.close()
    Image.open(target).convert("RGB").quantize(96).save(target, optimize=True)


if __name__ == "__main__":
    main()
