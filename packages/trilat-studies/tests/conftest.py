"""The browser in which pages of studies are opened."""

from tests.live.browsers import browser  # noqa: F401
