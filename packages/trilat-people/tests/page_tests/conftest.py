"""A page's server without a session."""

from collections.abc import Iterator

import pytest
from trilat_people.live_page.page_server import PageServer

from tests.net.local_bus import LocalNetwork
from trilat_net.net.clock import SystemClock


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    """The address of a page server of session `s1`, for the experimenter."""
    with PageServer(LocalNetwork().join(), SystemClock(), "s1") as server:
        yield server.address
