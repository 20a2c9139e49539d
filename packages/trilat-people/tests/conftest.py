"""The browser in which the pages of people are opened."""

from tests import drawn_examples  # noqa: F401 - loads a profile
from tests.live.browsers import browser  # noqa: F401
