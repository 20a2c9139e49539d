"""Pages that a browser has opened, and their faults: errors, empty frames, and charts without points.

Invariant:
- Only what the browser has drawn counts: pixels of canvases and pictures, boxes of shapes. The
  data of a page prove nothing.
- A page may read no field that it was not sent, unless it asks first whether the field is there.
"""

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from playwright.sync_api import Browser, BrowserContext, Page

OBSERVER = Path(__file__).with_name("observe_page.js")
AXE = Path(__file__).parent / "axe-core" / "axe.min.js"
"""axe-core 4.14.1 of Deque Systems, under the Mozilla Public License 2.0."""


class WatchedPage:
    """A page whose errors are collected from its beginning.

    Attributes:
        page: the page.
        errors: errors of its scripts and of its console, and requests that failed, in order.
    """

    def __init__(self, context: BrowserContext) -> None:
        self.errors: list[str] = []
        context.add_init_script(path=OBSERVER)
        self.page = context.new_page()
        self.page.on(
            "pageerror", lambda error: self.errors.append(f"uncaught: {error.stack or error}")
        )
        self.page.on("console", self._take_message)
        self.page.on(
            "requestfailed", lambda request: self.errors.append(f"not loaded: {request.url}")
        )

    def _take_message(self, message: Any) -> None:
        if message.type in ("error", "assert"):
            self.errors.append(f"console: {message.text}")

    def assert_whole(self, unsent: Collection[str] = ()) -> None:
        """Asserts that the page has no error and no empty frame, and that every chart has drawn points.

        Args:
            unsent: patterns of fields that the page may read although nobody has sent them.
        """
        faults = self.find_faults(unsent)
        assert not faults, "\n".join(faults)

    def find_faults(self, unsent: Collection[str] = ()) -> list[str]:
        """Returns what is wrong with the page, in words; the argument is that of `assert_whole`."""
        faults: list[str] = [*self.errors, *self.page.evaluate("observed.faults()")]
        faults += [
            f"a script reads {name}, which nobody has sent"
            for name in self.page.evaluate("observed.unsent()")
            if not any(fnmatch(name, pattern) for pattern in unsent)
        ]
        return faults


def grave_findings(page: Page) -> list[str]:
    """Returns the violations that axe-core calls serious or critical, each with its first element."""
    page.evaluate(AXE.read_text(encoding="utf-8"))
    violations: list[dict[str, Any]] = page.evaluate(
        "axe.run().then((found) => found.violations)"
    )
    grave = [
        violation for violation in violations if violation["impact"] in ("serious", "critical")
    ]
    return [
        f"{violation['id']}: {violation['nodes'][0]['html']}: {violation['nodes'][0]['failureSummary']}"
        for violation in grave
    ]


@contextmanager
def watched_page(browser: Browser, **options: Any) -> Iterator[WatchedPage]:
    """Opens a page in a separate context, and asserts at the end that it had no error."""
    context = browser.new_context(**options)
    try:
        watched = WatchedPage(context)
        yield watched
        assert watched.errors == []
    finally:
        context.close()
