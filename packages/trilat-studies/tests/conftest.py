"""The browser in which pages of studies are opened."""

from tests import drawn_examples  # noqa: F401 - loads a profile
from tests.live.browsers import browser  # noqa: F401
