"""Links as people write them: the statements of each model, and refusals with their key."""

import math
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.core.builders import Ints, compute_due_ns, make_channel
from tests.scenario.links import draw_link
from trilat_net.core.links.channel import LOST
from trilat_net.core.links.delay import MAX_DELAY_US, DelayKind
from trilat_net.errors import ScenarioError
from trilat_net.scenario import load_scenario
from trilat_net.scenario.delay_models import DELAY_MODELS, LinkBase


def load_link(keys: dict[str, Any]) -> LinkBase:
    loaded: LinkBase = load_scenario("paper", {"link": keys}).links["m1->s"]
    return loaded


@given(keys=draw_link())
def test_every_valid_link_has_moments_and_fates(keys: dict[str, Any]) -> None:
    loaded = load_link(keys)
    mean_ms, deviation_ms = loaded.moments()
    if not loaded.measured and not math.isnan(mean_ms):
        assert 0.0 <= mean_ms <= MAX_DELAY_US / 1000
        assert 0.0 <= deviation_ms < math.inf
    assert loaded.describe()
    points = loaded.points
    model = loaded.to_core_model()._replace(trace_count=0 if points is None else len(points))
    fates: Ints = compute_due_ns(make_channel([model], points=points), 50)
    kept = fates[fates != LOST]
    assert (kept >= 0).all()


@given(keys=draw_link())
def test_the_chain_of_losses_is_one(keys: dict[str, Any]) -> None:
    """Probabilities, and the stationary loss that the author wrote."""
    loaded = load_link(keys)
    model = loaded.to_core_model()
    assert all(
        0.0 <= p <= 1.0 + 1e-12
        for p in (model.loss_good, model.loss_bad, model.enter, model.leave)
    )
    bad = model.enter / (model.enter + model.leave)
    assert bad * model.loss_bad + (1 - bad) * model.loss_good == pytest.approx(
        loaded.loss, abs=1e-12
    )
    if loaded.loss_burst and loaded.loss:
        assert 1 / (1 - (1 - model.leave) * model.loss_bad) == pytest.approx(
            loaded.loss_burst, rel=1e-9
        )


def test_links_are_described_in_few_words() -> None:
    keys = {
        "loss": 0.05,
        "loss_burst": 8,
        "duplicate": 0.01,
        "outages_s": [[1, 2.5]],
        "order": "in_order",
    }
    description = load_link(
        {"model": "gamma", "delay_ms": 40, "deviation_ms": 10, "playout_ms": 80, **keys}
    ).describe()
    assert description == (
        "gamma 40 +- 10 ms, loss 5 % in bursts of 8, duplicates 1 %, cut 1-2.5 s, in order, play-out 80 ms"
    )
    assert load_link({"model": "none"}).describe() == "no delay"
    assert load_link({"delay_ms": 200}).describe() == "200 ms"
    assert load_link({"model": "measured", "loss": 1}).describe() == "measured, loss 100 %"


def test_a_table_with_a_model_begins_anew() -> None:
    base = {"model": "uniform", "delay_ms": 100.0, "half_width_ms": 50.0, "loss": 0.1}
    tables = {
        "m1->s": {"half_width_ms": 5.0},
        "m2->s": {"model": "constant", "delay_ms": 7},
        "s->m1": {"preset": "5g"},
    }
    loaded = load_scenario("paper", {"link": base, "links": tables}).links
    assert loaded["m1->s"].describe() == "uniform 95 to 105 ms, loss 10 %"
    assert loaded["m2->s"].describe() == "7 ms"
    assert loaded["s->m1"].describe() == "hyperexponential 21.5 +- 29.1 ms"
    assert loaded["s->m2"].describe() == "uniform 50 to 150 ms, loss 10 %"


@pytest.mark.parametrize(
    ("keys", "random", "measured"),
    [
        ({"delay_ms": 5}, False, False),
        ({"model": "sine", "delay_ms": 5, "amplitude_ms": 5, "period_s": 1}, False, False),
        ({"model": "trace", "trace": "0 5"}, False, False),
        ({"model": "measured"}, False, True),
        ({"delay_ms": 5, "loss": 0.1}, True, False),
        ({"delay_ms": 5, "loss": 1.0}, False, False),
        ({"model": "uniform", "delay_ms": 5, "half_width_ms": 1}, True, False),
    ],
)
def test_randomness_and_network_dependence_are_known(
    keys: dict[str, Any], random: bool, measured: bool
) -> None:
    scenario = load_scenario("paper", {"link": keys})
    assert (scenario.random, scenario.measured) == (random, measured)
    later = [{"at_s": 1, "link": "m1->s", "to": keys}]
    if keys.get("model") != "trace":
        changed = load_scenario("paper", {"timeline": later})
        assert (changed.random, changed.measured) == (random, measured)


# Bad input.


def test_links_have_at_most_a_thousand_outages() -> None:
    outages = [[second, second + 0.5] for second in range(1001)]
    with pytest.raises(ScenarioError) as caught:
        load_scenario("paper", {"link": {"delay_ms": 5, "outages_s": outages}})
    assert caught.value.path == "link.outages_s"


@given(
    model=st.sampled_from(["normal", "ar1", "gamma", "lognormal"]),
    delay_ms=st.floats(0, 1e4),
    deviation_ms=st.floats(0, 1e4, exclude_min=True),
)
def test_extreme_numbers_are_refused_or_have_moments(
    model: str, delay_ms: float, deviation_ms: float
) -> None:
    """No overflow, division by zero, or root of a negative number."""
    keys = {"delay_ms": delay_ms, "deviation_ms": deviation_ms}
    if model == "ar1":
        keys["correlation"] = 0.5
    try:
        model_of_link = msgspec.convert({"model": model, **keys}, DELAY_MODELS[model])
    except msgspec.ValidationError:
        return
    if model_of_link.find_problem() is None:
        assert all(math.isfinite(number) and number >= 0 for number in model_of_link.moments())
        assert model_of_link.to_core_model().kind in set(DelayKind)
        assert compute_due_ns(make_channel([model_of_link.to_core_model()]), 3).min() >= 0


def test_traces_may_reach_the_limit() -> None:
    assert load_link({"model": "trace", "trace": "0 0, 1 10000000"}).points is not None
