import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from .namespaces import Machines, NoNamespaces, machines
from .processes import PLAIN, Stage


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Everything here is live, and live sites need Linux."""
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker(pytest.mark.live)
            item.add_marker(
                pytest.mark.skipif(sys.platform != "linux", reason="live sites run on Linux")
            )


@pytest.fixture(autouse=True)
def processes_find_the_laws_of_tests_and_no_sessions_but_their_own(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setitem(PLAIN, "PYTHONPATH", str(Path(__file__).parents[2]))
    monkeypatch.setitem(PLAIN, "XDG_STATE_HOME", str(tmp_path / "state"))


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[Stage]:
    made = Stage(tmp_path)
    yield made
    made.clear()


@pytest.fixture
def apart() -> Iterator[Machines]:
    try:
        with machines() as made:
            yield made
    except NoNamespaces as reason:
        pytest.skip(str(reason))
