from pathlib import Path

import pytest

from tests.live.browsers import browser  # noqa: F401
from tests.log.standard_files import write_standard_files


@pytest.fixture(scope="session")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Returns logs with standard channels of every kind, by their kind."""
    return write_standard_files(tmp_path_factory.mktemp("files"))
