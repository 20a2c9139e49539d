import pytest

from tests.log_editing import recorded


@pytest.fixture(scope="session")
def short_log() -> bytes:
    """The bytes of a log of 0.3 s of virtual time."""
    return recorded("paper", {"duration_s": 0.3})
