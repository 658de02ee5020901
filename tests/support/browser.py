"""A real browser without a window, for the tests of the dashboard."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator
from typing import Any

from needs import require

DEADLINE_MS = 30_000
_SLOW_PICTURES = "GPU stall due to ReadPixels"
"""Said of each picture of what WebGL draws where there is no graphics card."""


@contextlib.contextmanager
def browser_page(width: int = 1400, height: int = 1100) -> Iterator[Any]:
    """A page of headless Chromium; what its scripts complain of fails the test."""
    from playwright.sync_api import sync_playwright

    require("Chromium")
    program = shutil.which("chromium") or shutil.which("google-chrome")
    complaints: list[str] = []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": width, "height": height})
        page.set_default_timeout(DEADLINE_MS)
        page.on("pageerror", lambda error: complaints.append(str(error)))

        def hear(message: Any) -> None:
            if message.type in ("error", "warning") and _SLOW_PICTURES not in message.text:
                complaints.append(message.text)

        page.on("console", hear)
        try:
            yield page
        finally:
            browser.close()
    assert complaints == [], complaints
