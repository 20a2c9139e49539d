"""Examples run as they stand, with and without what they would like to have."""

import runpy
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import pytest

from tests.log_editing import recorded

LOOK = Path(__file__).parents[1] / "examples" / "look_into_a_log.py"


@pytest.fixture(autouse=True)
def quiet(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    plt.switch_backend("agg")


@pytest.mark.parametrize("polars", [True, False])
def test_a_look_into_a_log(
    polars: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    if not polars:
        monkeypatch.setitem(sys.modules, "polars", None)
    (tmp_path / "run.mcap").write_bytes(recorded("paper"))
    monkeypatch.setattr(sys, "argv", [str(LOOK), "run.mcap"] if polars else [str(LOOK)])
    runpy.run_path(str(LOOK), run_name="__main__")
    plt.close("all")
    printed = capsys.readouterr().out
    assert "virtual session paper of m1, m2, s" in printed or "virtual session jitter" in printed
    assert ("no polars" in printed) is not polars
    assert (tmp_path / "look_into_a_log.png").read_bytes().startswith(b"\x89PNG")
