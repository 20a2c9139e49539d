"""How old samples are when they are used: by the rule of the links, and as a run says."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.virtual_runs import trajectories
from trilat_net.errors import ScenarioError
from trilat_net.scenario import Scenario, load_scenario
from trilat_net.theory.operating_point import compute_effective_delay


def scenario(**link: object) -> Scenario:
    return load_scenario(
        "two_sites", {"duration_s": 3.0, **{f"link.{key}": value for key, value in link.items()}}
    )


@given(delay_ms=st.floats(0, 500), rate_hz=st.sampled_from([100, 300, 1000]))
def test_constant_delay_is_in_use_from_next_tick_on(delay_ms: float, rate_hz: int) -> None:
    chosen = load_scenario("two_sites", {"link.delay_ms": delay_ms, "rate_hz": rate_hz})
    age = compute_effective_delay(chosen, "m", "s", chosen.links["m->s"])
    ticks = age.mean_s * rate_hz
    assert ticks == pytest.approx(round(ticks))
    assert age.mean_s >= max(1 / rate_hz, round(1e3 * delay_ms) / 1e6 - 1e-12)
    assert age.mean_s < max(1 / rate_hz, round(1e3 * delay_ms) / 1e6) + 1 / rate_hz
    assert age.least_s == age.most_s == age.mean_s


@pytest.mark.parametrize(
    "overrides",
    [
        {"link.model": "uniform", "link.delay_ms": 60.0, "link.half_width_ms": 50.0},
        {"link.delay_ms": 40.0, "link.loss": 0.3},
        {"link.delay_ms": 40.0, "sites.m.rate_hz": 110},
        {"link.model": "sine", "link.delay_ms": 60.0, "link.amplitude_ms": 40.0, "link.period_s": 1.0},
    ],
    ids=["jitter", "loss", "rates", "sine"],
)
def test_the_mean_is_that_of_a_run(overrides: dict[str, object]) -> None:
    chosen = load_scenario("two_sites", {"duration_s": 3.0, "rate_hz": 500, **overrides})
    age = compute_effective_delay(chosen, "m", "s", chosen.links["m->s"])
    run = trajectories(chosen).sites["s"]
    used = run.used[:, 0]
    ages_s = (run.t_s - used / chosen.sites["m"].rate_hz)[used >= 0]
    assert age.mean_s == pytest.approx(ages_s.mean(), abs=1e-5)
    assert age.most_s == pytest.approx(ages_s.max(), abs=1e-5)


def test_play_out_makes_jitter_a_constant_delay() -> None:
    chosen = scenario(model="uniform", delay_ms=60.0, half_width_ms=50.0, playout_ms=110.0)
    age = compute_effective_delay(chosen, "m", "s", chosen.links["m->s"])
    assert np.allclose(age, 0.110)


def test_a_link_that_delivers_nothing_is_refused() -> None:
    chosen = scenario(loss=1.0)
    with pytest.raises(ScenarioError, match=r"links\.m->s: no sample of it ever comes"):
        compute_effective_delay(chosen, "m", "s", chosen.links["m->s"])
