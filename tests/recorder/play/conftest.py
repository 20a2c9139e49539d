import pytest

from tests.log_editing import recorded


@pytest.fixture(scope="session")
def short_log() -> bytes:
    return recorded("paper", {"duration_s": 0.3})
