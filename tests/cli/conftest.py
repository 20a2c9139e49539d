import io

import pytest

from trilat_net.execution import virtual
from trilat_net.scenario import load_scenario


@pytest.fixture(scope="session")
def short_log() -> bytes:
    """The bytes of a log of half a second of virtual time."""
    stream = io.BytesIO()
    virtual.write_virtual_log(load_scenario("paper", {"duration_s": 0.5}), stream)
    return stream.getvalue()
