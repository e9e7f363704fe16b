"""A page in headless Chromium: what it asks for, says, and how it stands on a phone and a desk."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.resources import files

import pytest
from playwright.sync_api import Browser, Page, sync_playwright

SIZES = {"phone": (390, 844), "desk": (1440, 900)}
CHROMIUM = os.environ.get("CHROMIUM") or shutil.which("chromium")

needs_chromium = pytest.mark.skipif(
    CHROMIUM is None, reason="no Chromium: make browser installs it, or give CHROMIUM"
)


@dataclass
class Visit:
    """A page that was opened, and what came of it."""

    page: Page
    errors: list[str] = field(default_factory=list)
    """Of the console."""
    requests: list[str] = field(default_factory=list)
    """Addresses that it asked for, itself included."""

    def overflow(self) -> bool:
        """Whether it must be scrolled sideways."""
        return self.page.evaluate(
            "document.documentElement.scrollWidth > document.documentElement.clientWidth"
        )

    def inaccessible(self, unclear: bool = True) -> list[str]:
        """What axe-core finds against WCAG 2.1 AA, contrast included; and what it cannot tell."""
        self.page.evaluate(files("axe_playwright_python").joinpath("axe.min.js").read_text())
        found = self.page.evaluate(
            """() => axe.run(document, {
            runOnly: {type: 'tag', values: ['wcag2a', 'wcag2aa', 'wcag21a', 'wcag21aa']},
            resultTypes: ['violations', 'incomplete']})"""
        )
        return [
            f"{rule['id']}: {node['target']} {node.get('failureSummary')}"
            for rule in (*found["violations"], *(found["incomplete"] if unclear else ()))
            for node in rule["nodes"]
        ]


@contextmanager
def chromium() -> Iterator[Browser]:
    """A browser. While it is open, this thread can run no asyncio."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM)
        yield browser
        browser.close()


def visit(browser: Browser, address: str, size: str, offline: bool = False) -> Visit:
    """Open an address in a window of that size."""
    width, height = SIZES[size]
    context = browser.new_context(
        viewport={"width": width, "height": height}, offline=offline, reduced_motion="reduce"
    )
    page = context.new_page()
    seen = Visit(page)
    page.on(
        "console",
        lambda message: (
            seen.errors.append(message.text) if message.type in ("error", "warning") else None
        ),
    )
    page.on("pageerror", lambda error: seen.errors.append(str(error)))
    context.on("request", lambda request: seen.requests.append(request.url))
    page.goto(address)
    return seen
