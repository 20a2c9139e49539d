import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.live.namespaces import make_machines

from .namespaces import Machines, NoNamespaces
from .processes import PLAIN, Stage


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Marks all tests of the folder as live, and skips them where live sites cannot run."""
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
    new_stage = Stage(tmp_path)
    yield new_stage
    new_stage.clear()


@pytest.fixture
def apart() -> Iterator[Machines]:
    try:
        with make_machines() as all_machines:
            yield all_machines
    except NoNamespaces as reason:
        pytest.skip(str(reason))
