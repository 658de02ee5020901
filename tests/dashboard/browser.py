"""A real browser without a window, for the tests of the dashboard."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Iterator
from typing import Any

import pytest

DEADLINE_MS = 30_000


@contextlib.contextmanager
def browser_page(width: int = 1400, height: int = 1100) -> Iterator[Any]:
    """A page of headless Chromium; what its scripts complain of fails the test."""
    from playwright.sync_api import sync_playwright

    program = shutil.which("chromium") or shutil.which("google-chrome")
    if program is None:
        if "CI" in os.environ:
            pytest.fail("CI has to test the dashboard: apt install chromium")
        pytest.skip("Chromium is not installed: apt install chromium")
    complaints: list[str] = []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": width, "height": height})
        page.set_default_timeout(DEADLINE_MS)
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on(
            "console",
            lambda message: (
                complaints.append(message.text) if message.type in ("error", "warning") else None
            ),
        )
        try:
            yield page
        finally:
            browser.close()
    assert complaints == []
