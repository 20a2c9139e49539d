"""Examples run as they stand, with and without what they would like to have."""

import runpy
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest

import trilat_net
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


def test_springs_with_reactions_rest_where_their_sum_is_zero(monkeypatch: pytest.MonkeyPatch) -> None:
    """Forces of springs that act at both ends move no centre: by d qd_i summed, the mean pose stays."""
    monkeypatch.syspath_prepend(LOOK.parent)
    law = {"control.law": "reaction_law:Reaction", "link.delay_ms": 5.0, "duration_s": 6.0}
    log = trilat_net.simulate("free", {**law, "scheme": "digital"})
    poses = np.array([log[name].q[-1] for name in log.sites])
    started = np.mean([log[name].q[0] for name in log.sites], axis=0)
    np.testing.assert_allclose(poses, np.broadcast_to(poses[0], poses.shape), atol=2e-3)
    pulls = [log[name].states[-1].ch for name in log.sites]
    assert np.abs(pulls).max() < 0.05
    np.testing.assert_allclose(poses.mean(axis=0), started, atol=0.05)
    assert trilat_net.verify(log).passed
