"""The browser in which the pages of people are opened."""

from tests.live.browsers import browser  # noqa: F401
