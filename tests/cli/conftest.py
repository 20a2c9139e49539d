import pytest

from tests.log.builders import make_log_bytes


@pytest.fixture(scope="session")
def short_log() -> bytes:
    return make_log_bytes("paper", {"duration_s": 0.5})
