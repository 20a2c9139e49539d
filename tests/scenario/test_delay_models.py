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


def refused(keys: dict[str, Any]) -> ScenarioError:
    with pytest.raises(ScenarioError) as error:
        load_scenario("paper", {"link": keys})
    assert error.value.exit_code == 2
    return error.value


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


@pytest.mark.parametrize(
    ("keys", "path", "phrase"),
    [
        ({"model": "unifrom"}, "link.model", "did you mean 'uniform'"),
        ({"model": 3}, "link.model", "must be one of"),
        ({"preset": "5G"}, "link.preset", "did you mean '5g'"),
        (
            {"preset": "4g", "model": "uniform"},
            "link.model",
            "the preset '4g' is 'hyperexponential'",
        ),
        ({"preset": "4g", "delay_ms": 5}, "link.delay_ms", "belongs to model"),
        (
            {"model": "uniform", "delay_ms": 5, "deviation_ms": 1},
            "link.deviation_ms",
            "belongs to model",
        ),
        ({"model": "measured", "delay_ms": 5}, "link.delay_ms", "belongs to model"),
        ({"delay_ms": 5, "los": 0.1}, "link.los", "did you mean 'loss'"),
        (
            {"model": "constant", "delay_ms": 5, "file": "x.csv"},
            "link.file",
            "belongs to model",
        ),
        ({"model": "gamma", "delay_ms": 5}, "deviation_ms", "is missing"),
        ({"model": "hyperexponential", "floor_ms": 5}, "fast_ms", "is missing"),
    ],
)
def test_links_do_not_accept_other_keys(keys: dict[str, Any], path: str, phrase: str) -> None:
    error = refused(keys)
    assert path in error.path
    assert phrase in error.problem


@pytest.mark.parametrize(
    ("keys", "key"),
    [
        ({"delay_ms": -1}, "delay_ms"),
        ({"delay_ms": 10_001}, "delay_ms"),
        ({"delay_ms": "much"}, "delay_ms"),
        ({"delay_ms": 5, "loss": 1.1}, "loss"),
        ({"delay_ms": 5, "duplicate": 2}, "duplicate"),
        ({"delay_ms": 5, "loss_bad": 0}, "loss_bad"),
        ({"delay_ms": 5, "loss_burst": -1}, "loss_burst"),
        ({"delay_ms": 5, "playout_ms": 10_001}, "playout_ms"),
        ({"delay_ms": 5, "order": "in order"}, "order"),
        ({"delay_ms": 5, "outages_s": [[1, 2, 3]]}, "outages_s[0]"),
        ({"delay_ms": 5, "outages_s": [[-1, 2]]}, "outages_s[0][0]"),
        ({"delay_ms": 5, "outages_s": [[n, n + 0.5] for n in range(1001)]}, "outages_s"),
        ({"model": "normal", "delay_ms": 5, "deviation_ms": 0}, "deviation_ms"),
        ({"model": "gamma", "delay_ms": 0, "deviation_ms": 1}, "delay_ms"),
        ({"model": "ar1", "delay_ms": 5, "deviation_ms": 1, "correlation": 1.0}, "correlation"),
        ({"model": "sine", "delay_ms": 5, "amplitude_ms": 1, "period_s": 0}, "period_s"),
        ({"model": "trace", "trace": "0 5", "at_end": "stop"}, "at_end"),
        ({"delay_ms": math.nan}, "delay_ms"),
        # what no range of a single key shows
        ({"model": "uniform", "delay_ms": 5, "half_width_ms": 6}, "half_width_ms"),
        ({"model": "sine", "delay_ms": 5, "amplitude_ms": 6, "period_s": 1}, "amplitude_ms"),
        ({"model": "uniform", "delay_ms": 9000, "half_width_ms": 2000}, "model"),
        ({"model": "gamma", "delay_ms": 5000, "deviation_ms": 2000}, "model"),
        ({"model": "gamma", "delay_ms": 1e4, "deviation_ms": 1e-300}, "deviation_ms"),
        ({"model": "lognormal", "delay_ms": 1e-300, "deviation_ms": 1e4}, "deviation_ms"),
        ({"delay_ms": 5, "outages_s": [[1, 2], [5, 3]]}, "outages_s[1]"),
        ({"delay_ms": 5, "loss": 0.1, "loss_burst": 0.5}, "loss_burst"),
        ({"delay_ms": 5, "loss": 0.9, "loss_burst": 2}, "loss_burst"),
        ({"delay_ms": 5, "loss": 1.0, "loss_burst": 2}, "loss"),
        ({"delay_ms": 5, "loss": 0.1, "loss_bad": 0.5, "loss_burst": 2}, "loss_burst"),
        ({"delay_ms": 5, "loss": 0.5, "loss_bad": 0.5, "loss_burst": 1.5}, "loss"),
    ],
)
def test_invalid_values_are_refused_with_their_key(keys: dict[str, Any], key: str) -> None:
    error = refused(keys)
    assert error.path.endswith(key)
    assert error.path.startswith("link")
    assert error.problem


def test_wrong_choices_name_the_valid_ones() -> None:
    assert refused({"delay_ms": 5, "order": "in order"}).problem == (
        "is 'in order', but must be 'newest' or 'in_order'"
    )
    assert (
        "'hold' or 'loop'" in refused({"model": "trace", "trace": "0 5", "at_end": "x"}).problem
    )


def test_the_longest_burst_that_holes_allow_is_named() -> None:
    problem = refused({"delay_ms": 5, "loss": 0.1, "loss_bad": 0.75, "loss_burst": 9}).problem
    assert problem == "must be below 4 with loss_bad = 0.75"


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
