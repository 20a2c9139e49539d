"""Links by name: each preset has the numbers of its source."""

import math
import tomllib

import pytest
from scipy import stats

from trilat_net.scenario import load_scenario
from trilat_net.scenario.delay_models.kernel_delays import HyperExponentialDelay
from trilat_net.scenario.link_presets import PRESETS, PRESETS_FILE

ROUND_TRIPS_MS = {
    "frankfurt-bangalore": (144.88, 2.18),
    "frankfurt-newyork": (83.93, 0.28),
    "london-sydney": (262.89, 1.76),
    "sf-bangalore": (218.09, 0.60),
    "sf-buenos_aires": (203.03, 3.54),
    "sf-shanghai": (150.10, 0.37),
}
"""WonderNetwork, 10 November 2018: average and deviation."""


@pytest.mark.parametrize("name", PRESETS)
def test_presets_make_scenarios_everywhere(name: str) -> None:
    for scenario in (
        load_scenario("paper", [f"link.preset={name}"]),
        load_scenario("paper", {"links": {"m1->s": {"preset": name}}}),
        load_scenario(
            "paper", {"timeline": [{"at_s": 1, "link": "m1->s", "to": {"preset": name}}]}
        ),
    ):
        assert repr(name) not in scenario.text.replace('"', "'")
        assert scenario.setup("s").links[0].models


@pytest.mark.parametrize(("name", "round_trip"), ROUND_TRIPS_MS.items())
def test_city_pairs_are_half_a_round_trip(name: str, round_trip: tuple[float, float]) -> None:
    mean_ms, deviation_ms = (
        load_scenario("paper", {"link": {"preset": name}}).links["m1->s"].moments()
    )
    assert 2 * mean_ms == pytest.approx(round_trip[0], abs=0.011)
    assert math.sqrt(2) * deviation_ms == pytest.approx(round_trip[1], abs=0.01)


def test_wifi_has_half_the_measured_percentiles() -> None:
    keys = {key: value for key, value in PRESETS["wifi"].items() if key != "model"}
    link = HyperExponentialDelay(**keys)
    parts = (stats.expon(link.floor_ms, link.fast_ms), stats.expon(link.floor_ms, link.slow_ms))
    for round_trip_ms, share in ((3, 0.5), (20, 0.9), (250, 0.99)):
        below = [part.cdf(round_trip_ms / 2) for part in parts]
        assert (1 - link.slow_share) * below[0] + link.slow_share * below[1] == pytest.approx(
            share, abs=2e-3
        )


def test_lan_has_half_the_measured_quartiles() -> None:
    mean = PRESETS["lan"]["delay_ms"]
    deviation = PRESETS["lan"]["deviation_ms"]
    law = stats.gamma((mean / deviation) ** 2, scale=deviation**2 / mean)
    assert 2 * law.median() == pytest.approx(0.542, rel=0.01)
    quartiles = law.ppf(0.75) - law.ppf(0.25)
    assert math.sqrt(2) * quartiles == pytest.approx(0.564 - 0.514, rel=0.05)


def test_mobile_and_satellite_follow_their_sources() -> None:
    def described(name: str) -> str:
        return load_scenario("paper", {"link": {"preset": name}}).links["m1->s"].describe()

    assert PRESETS["4g"]["floor_ms"] + 0.8 * 10 + 0.2 * 150 == 53
    assert described("4g") == "hyperexponential 53 +- 87.8 ms"
    assert PRESETS["5g"]["floor_ms"] + 0.8 * 5 + 0.2 * 50 == 21.5
    assert described("5g") == "hyperexponential 21.5 +- 29.1 ms"
    assert (PRESETS["geo"]["floor_ms"], described("geo")) == (
        550 / 2,
        "hyperexponential 300 +- 25 ms",
    )


def test_the_grid_follows_half_round_trips() -> None:
    link = load_scenario("paper", {"link": {"preset": "rtt136-loss25"}}).links["m1->s"]
    assert (link.moments(), link.loss, link.loss_burst) == ((68.0, 0.0), 0.25, 0.0)


def test_every_preset_has_a_sourced_comment() -> None:
    text = PRESETS_FILE.read_text(encoding="utf-8")
    for name in tomllib.loads(text):
        head = f'["{name}"]' if name[0].isdigit() else f"[{name}]"
        body = text.split(head, 1)[1].split("\n\n", 1)[0]
        assert body.lstrip().startswith("#"), name
