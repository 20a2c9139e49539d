import sys
from pathlib import Path

import pytest

from tests.live.conftest import (  # noqa: F401
    processes_find_the_laws_of_tests_and_no_sessions_but_their_own,
    stage,
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Everything here is live, and live sites need Linux."""
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker(pytest.mark.live)
            item.add_marker(
                pytest.mark.skipif(sys.platform != "linux", reason="live sites run on Linux")
            )
