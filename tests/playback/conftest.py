import io

import pytest

from trilat_net.scenario import load
from trilat_net.sim import virtual


@pytest.fixture(scope="session")
def short_log() -> bytes:
    """The bytes of a log of 0.3 s of virtual time."""
    stream = io.BytesIO()
    virtual.record(load("paper", {"duration_s": 0.3}), stream)
    return stream.getvalue()
