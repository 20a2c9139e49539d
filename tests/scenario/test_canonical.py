"""The canonical text of a scenario, over every feature of a scenario."""

from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.scenario.links import draw_link
from trilat_net.scenario import list_shipped, load_scenario, parse_scenario
from trilat_net.scenario.scenario_reader import read_shipped

TEXT = read_shipped("paper")
NAMES = ("m1", "m2", "s")
EVERY = [f"{j}->{i}" for i in NAMES for j in NAMES if i != j]
pair = st.tuples(st.floats(0.01, 50), st.floats(0.01, 50)).map(list)
vector = st.floats(0.01, 50) | pair
texts = st.sampled_from(['a """ b', "end \\", "a\r\nb", "[\n    1.0,\n]", "\x00"]) | st.text(
    max_size=60
)

laws = st.fixed_dictionaries(
    {"law": st.just("adaptive")},
    optional={"Lambda": vector, "Kp": vector, "Kd": vector, "theta_hat0": st.floats(-5, 5)},
) | st.fixed_dictionaries({"law": st.just("p_d")}, optional={"K": vector, "d": vector})
stale = st.fixed_dictionaries(
    {"age_ms": st.floats(10_001, 1e5)},  # above every delay
    optional={
        "action": st.sampled_from(["use", "hold", "brake"]),
        "return_s": st.floats(0.001, 100),
    },
)


@st.composite
def draw_row(draw: st.DrawFn, site: str) -> dict[str, float]:
    share = draw(st.floats(0, 1))
    first, other = (name for name in NAMES if name != site)
    return {first: share, other: 1 - share}


@st.composite
def draw_changes(draw: st.DrawFn) -> list[dict[str, Any]]:
    times = sorted(draw(st.lists(st.floats(0, 100) | st.integers(0, 100), max_size=4)))
    changes_made = []
    for at_s in times:
        if draw(st.booleans()):
            to = draw(draw_link(without=("trace",)))
            to.pop("outages_s", None)
            changes_made.append({"at_s": at_s, "link": draw(st.sampled_from(EVERY)), "to": to})
        else:
            site = draw(st.sampled_from(NAMES))
            changes_made.append({"at_s": at_s, "dominance": site, "to": draw(draw_row(site))})
            changes_made[-1] |= draw(
                st.fixed_dictionaries({}, optional={"ramp_s": st.floats(0, 10)})
            )
    return changes_made


overrides = st.fixed_dictionaries(
    {},
    optional={
        "link": draw_link(),
        "sites.m1.view": draw_link(without=("measured",)),
        "links": st.dictionaries(st.sampled_from(EVERY), draw_link(), max_size=3),
        "control": laws,
        "sites.s.control": laws,
        "on_stale": stale,
        "sites.m2.on_stale": stale,
        "dominance.m1": draw_row("m1"),
        "timeline": draw_changes(),
        "seed": st.integers(0, 2**63 - 1),
        "expect": st.fixed_dictionaries({}, optional={"stable": st.booleans()}),
        "title": texts,
        "about": texts,
        "assumed": st.lists(st.text(max_size=20), max_size=3),
        "sites.s.q0_rad": st.lists(st.floats(-1e6, 1e6), min_size=2, max_size=2),
        "sites.m2.rate_hz": st.integers(1, 20_000),
        "arm.m1_kg": st.floats(0.001, 1e6),
        "duration_s": st.floats(1e-6, 86_400.0),
        "scheme": st.sampled_from(["second_order", "digital"]),
    },
)


@settings(max_examples=100)
@given(changed=overrides)
def test_the_canonical_text_loads_to_the_same_scenario(changed: dict[str, Any]) -> None:
    scenario = parse_scenario(TEXT, overrides=changed)
    again = parse_scenario(scenario.text)
    assert again.text == scenario.text
    assert again == scenario
    assert (again.sha256, list(again.sites)) == (scenario.sha256, list(scenario.sites))
    assert msgspec.to_builtins(again.timeline) == msgspec.to_builtins(scenario.timeline)
    for name in scenario.names:
        setup = scenario.setup(name)
        other = again.setup(name)
        assert [link.models for link in setup.links] == [link.models for link in other.links]
        assert [link.key for link in setup.links] == [link.key for link in other.links]
        assert (setup.ramps, setup.on_stale, setup.gains) == (
            other.ramps,
            other.on_stale,
            other.gains,
        )


@pytest.mark.parametrize("name", list_shipped())
def test_unrequested_features_are_not_in_the_text(name: str) -> None:
    """The hash of an experiment does not change when the program gains a feature."""
    text = load_scenario("paper", {"expect": {}}).text
    assert not any(
        word in text for word in ("on_stale", "timeline", "expect", "loss", "playout")
    )
    assert ("timeline" in load_scenario(name).text) == bool(load_scenario(name).timeline)


def test_350_and_350_point_0_are_one_experiment() -> None:
    def sha256(delay_ms: float, at_s: float) -> str:
        change = {"at_s": at_s, "link": "m1->s", "to": {"delay_ms": delay_ms}}
        return load_scenario("paper", {"timeline": [change]}).sha256

    assert sha256(350, 8) == sha256(350.0, 8.0)
    assert sha256(350, 8) != sha256(351, 8)
