"""Take the README's picture: the first screen of the report that `make demo` wrote.

Run by `make picture`; needs chromium. Another report is named as the only argument:
`python -m tests.tools.picture FOLDER`.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

from PIL import Image
from playwright.sync_api import sync_playwright

ROOT = Path(__file__).parents[2]
PAGES = ROOT / "demo" / "result"


def main(folder: Path = PAGES) -> None:
    """Write the first screen of the report to studies/report.png, in few colours."""
    pages = [
        path
        for path in sorted(folder.glob("*.html"))
        if path.name not in ("index.html", "how-to-read.html")
    ]
    if not pages:
        sys.exit(f"{folder} holds no report: run `make demo` first")
    target = ROOT / "studies" / "report.png"
    with sync_playwright() as play:
        browser = play.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--no-sandbox"]
        )
        page = browser.new_page(viewport={"width": 1120, "height": 1400})
        page.goto(pages[0].resolve().as_uri())
        box = page.locator("section.first").bounding_box()
        below = box["y"] + box["height"] if box else 690.0
        page.screenshot(path=target, clip={"x": 0, "y": 0, "width": 1120, "height": below + 16})
        browser.close()
    Image.open(target).convert("RGB").quantize(128, Image.Quantize.MAXCOVERAGE).save(
        target, optimize=True
    )


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:2]))
