"""A browser without a network for tests of pages: Chromium, where it and its driver are installed."""

from __future__ import annotations

import os
import shutil
from contextlib import contextmanager

import pytest


def missing(reason):
    """Skip the test, or fail it where WARP_GI_BROWSER says that a browser is required."""
    (pytest.fail if os.environ.get("WARP_GI_BROWSER") == "required" else pytest.skip)(reason)


@contextmanager
def started_browser(*flags):
    """Chromium with more flags."""
    try:
        import playwright.sync_api as driver
    except ImportError:
        missing("no driver: pip install '.[browser]'")
    found = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if found is None:
        missing("no Chromium on the path: apt-get install chromium")
    with driver.sync_playwright() as p:
        started = p.chromium.launch(executable_path=found, args=["--no-sandbox", *flags])
        yield started
        started.close()


@contextmanager
def opened_page(browser, path, width=1280, height=900, address=""):
    """A page, offline; at the end nothing must have failed or have been asked of a network."""
    context = browser.new_context(viewport={"width": width, "height": height}, offline=True)
    opened, messages, requests = context.new_page(), [], []
    opened.on("console", lambda message: messages.append(message.text))
    opened.on("pageerror", lambda error: messages.append(str(error)))
    opened.on("request", lambda request: requests.append(request.url))
    opened.goto(path.as_uri() + address)
    yield opened
    assert messages == []
    assert [url for url in requests if not url.startswith(("file:", "data:", "blob:"))] == []
    context.close()
