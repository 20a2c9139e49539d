"""The peers as shown to a site's user: a link beside the haptic one, by scenario, seed and ticks."""

from typing import Any

import numpy as np
import pytest

import trilat_net as tn
from trilat_net.core.links.philox import link_key
from trilat_net.scenario import load_scenario
from trilat_net.scenario.picture_delay import PictureDelay

MODELS = {
    "constant": {"delay_ms": 130.0},
    "lossy gamma": {
        "model": "gamma",
        "delay_ms": 90.0,
        "deviation_ms": 40.0,
        "loss": 0.3,
        "loss_burst": 5.0,
    },
    "in order": {
        "model": "uniform",
        "delay_ms": 90.0,
        "half_width_ms": 80.0,
        "order": "in_order",
    },
    "played out": {
        "model": "ar1",
        "delay_ms": 40.0,
        "deviation_ms": 9.0,
        "correlation": 0.9,
        "playout_ms": 60.0,
    },
}


@pytest.mark.parametrize("view", MODELS.values(), ids=MODELS)
@pytest.mark.parametrize("peer_hz", [1000, 400])
def test_pictures_are_delayed_like_links(view: dict[str, Any], peer_hz: int) -> None:
    scenario = load_scenario("paper", {"sites.m1.view": view, "sites.s.rate_hz": peer_hz})
    picture = PictureDelay(scenario, "m1")
    model = scenario.sites["m1"].view
    assert model is not None
    used = model.draw_used_samples(link_key(scenario.seed, "view s->m1"), 1000, peer_hz, 2.0)
    assert [picture.advance_to(tick, {})["s"] for tick in range(2000)] == used.tolist()


def test_late_viewers_see_the_same() -> None:
    scenario = load_scenario("paper", {"sites.m1.view": MODELS["lossy gamma"], "rate_hz": 50})
    from_first, late = (PictureDelay(scenario, "m1") for _ in range(2))
    states = [from_first.advance_to(tick, {}) for tick in range(3000)]
    assert [late.advance_to(tick, {}) for tick in range(2800, 3000)] == states[2800:]


def test_outages_show_nothing() -> None:
    view = {"delay_ms": 100.0, "outages_s": [[0.5, 1.0]]}
    picture = PictureDelay(load_scenario("paper", {"sites.m1.view": view}), "m1")
    pictures = np.array([picture.advance_to(tick, {})["s"] for tick in range(1500)])
    assert pictures[[599, 600, 1099, 1100]].tolist() == [499, 499, 499, 1000]


def test_pictures_never_influence_the_run() -> None:
    """Every record stays, and the log contains the shown samples."""
    keys = {"duration_s": 1.0, "rate_hz": 200}
    plain = tn.simulate("paper", keys)
    delayed = tn.simulate("paper", {**keys, "sites.m1.view.delay_ms": 250.0})
    for site in plain.sites:
        for name in ("q", "q_des", "tau", "theta_hat"):
            assert np.array_equal(getattr(plain[site], name), getattr(delayed[site], name))
    assert {peer: ticks.tolist() for peer, ticks in plain.shown("m1").items()} == {
        peer: ticks.tolist() for peer, ticks in plain["m1"].used.items()
    }
    assert delayed.shown("m1")["s"].tolist() == [max(-1, tick - 50) for tick in range(200)]
    assert delayed.shown("m2")["s"].tolist() == plain["m2"].used["s"].tolist()
