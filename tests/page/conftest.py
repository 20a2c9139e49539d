"""The browser in which pages are opened."""

from tests.live.browsers import browser  # noqa: F401
