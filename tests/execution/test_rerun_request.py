"""Requests for reruns: valid changes, and refusals with their reason."""

from collections.abc import Mapping, Sequence
from typing import Any

import pytest

from tests.log.builders import make_log
from trilat_net.errors import ScenarioError, UsageError
from trilat_net.execution.rerun_execution import RerunRequest

from .deliveries import SITES

Overrides = Mapping[str, Any] | Sequence[str]


def request_rerun(
    replace: Sequence[str], overrides: Overrides = (), *, closed_loop: bool = False
) -> RerunRequest:
    return RerunRequest.resolve(make_log("paper"), replace, overrides, closed_loop=closed_loop)


def test_an_unchanged_request_is_the_logs_experiment() -> None:
    for name in ("paper", "handover", "outage"):
        log = make_log(name, {"duration_s": 0.3})
        for replace in (log.sites[:1], log.sites):
            request = RerunRequest.resolve(log, replace, (), closed_loop=False)
            assert request.scenario == log.scenario
            assert (
                request.changes,
                request.without_effect,
                request.describe_changes(),
            ) == (
                [],
                [],
                [],
            )


@pytest.mark.parametrize(
    ("overrides", "arguments"),
    [
        (["control.Kd=5"], ["control.Kd of s: 3 -> 5"]),
        (["sites.s.control.Kd=[5,6]"], ["control.Kd of s: 3 -> [5, 6]"]),
        (["link.delay_ms=30"], ["m1->s, m2->s: 20 ms -> 30 ms"]),
        (["links.m2->s.loss=0.25"], ["m2->s: 20 ms -> 20 ms, loss 25 %"]),
        (
            ["dominance.s.m1=0.9", "dominance.s.m2=0.1"],
            ["dominance.s.m1: 0.5 -> 0.9", "dominance.s.m2: 0.5 -> 0.1"],
        ),
        (["seed=7"], ["seed: 1 -> 7"]),
        (["duration_s=0.05"], ["duration_s: 0.12 -> 0.05"]),
        (["control.Kd=3"], []),
        (
            ["control.law=p_d", "control.K=20"],
            [
                "control of s: adaptive (Lambda 1, Kp 1, Kd 3, Gamma 1, theta_hat0 0) -> "
                "p_d (K 20, d 3, gravity 1)"
            ],
        ),
    ],
    ids=str,
)
def test_differences_are_lines_of_the_executed_scenario(
    overrides: list[str], arguments: list[str]
) -> None:
    assert request_rerun(["s"], overrides).describe_changes() == arguments


def test_copied_sites_keep_their_settings() -> None:
    request = request_rerun(["s"], {"control.Kd": 5, "link.delay_ms": 30.0, "arm.m2_kg": 2.0})
    original = make_log("paper").scenario
    for name in ("m1", "m2"):
        assert request.scenario.sites[name] == original.sites[name]
        assert request.scenario.links[f"s->{name}"] == original.links[f"s->{name}"]
    assert request.scenario.sites["s"].arm.m2_kg == 2.0
    assert {changed.key for changed in request.without_effect} >= {
        "sites.m1.control.Kd",
        "links.s->m2.delay_ms",
    }


def test_each_site_has_its_own_timeline() -> None:
    timeline = [
        {"at_s": 0.01, "link": "m1->s", "to": {"delay_ms": 5.0}},
        {"at_s": 0.02, "link": "s->m1", "to": {"delay_ms": 6.0}},
        {"at_s": 0.03, "dominance": "s", "to": {"m1": 1.0}},
    ]
    request = request_rerun(["s"], {"timeline": timeline})
    assert [(change.link, change.dominance) for change in request.scenario.timeline] == [
        ("m1->s", ""),
        ("", "s"),
    ]
    assert (
        len(request_rerun([], {"timeline": timeline}, closed_loop=True).scenario.timeline) == 3
    )


def test_all_sites_make_a_closed_loop() -> None:
    assert (
        request_rerun(SITES).mode == request_rerun([], closed_loop=True).mode == "closed loop"
    )
    assert request_rerun(["s", "m1", "s"]).replaced == ("m1", "s")
    assert request_rerun(["s", "m1"]).mode == "open loop"


@pytest.mark.parametrize(
    ("replace", "closed_loop", "facts"),
    [
        ([], False, ["replace", "m1, m2, s", "closed_loop=True"]),
        (["s"], True, ["replace", "closed_loop=True"]),
    ],
)
def test_sites_must_be_named_once(
    replace: list[str], closed_loop: bool, facts: list[str]
) -> None:
    with pytest.raises(UsageError) as caught:
        request_rerun(replace, closed_loop=closed_loop)
    assert all(fact in str(caught.value) for fact in facts)


@pytest.mark.parametrize(
    ("overrides", "facts"),
    [
        (["control.Kdd=5"], ["control.Kdd", "did you mean 'Kd'"]),
        (["sites.q.control.Kd=5"], ["sites.q", "m1, m2, s"]),
        (["rate_hz=500"], ["rate_hz", "closed_loop=True"]),
        (["sites.s.rate_hz=500"], ["sites.s.rate_hz", "closed_loop=True"]),
        (["sites.m1.rate_hz=500"], ["sites.m1.rate_hz", "closed_loop=True"]),
        (["sites.m1.control.Kd=5"], ["sites.m1.control.Kd", "replace m1", "only s"]),
        (["links.s->m1.delay_ms=5"], ["links.s->m1", "receiver", "replace m1"]),
        (["dominance.m2.s=1"], ["dominance.m2", "replace m2"]),
        (["duration_s=30"], ["duration_s", "0.12 s", "not known"]),
        (["name=other"], ["name", "only describes the scenario"]),
        (["expect.stable=true"], ["expect.stable", "only describes the scenario"]),
    ],
    ids=str,
)
def test_fixed_settings_are_refused_with_reason(overrides: list[str], facts: list[str]) -> None:
    with pytest.raises(ScenarioError) as caught:
        request_rerun(["s"], overrides)
    assert all(fact in str(caught.value) for fact in facts), caught.value


def test_an_unknown_site_is_refused_with_the_nearest() -> None:
    with pytest.raises(ScenarioError, match="no site 'm3'; did you mean 'm"):
        request_rerun(["m3"])


@pytest.mark.parametrize("other", [{"x": {"role": "slave"}}, {"s": {"rate_hz": 5}}])
def test_whole_tables_cannot_change_sites_or_rates(other: dict[str, Any]) -> None:
    with pytest.raises(ScenarioError):
        request_rerun(
            ["s"], {"sites": {"m1": {"role": "slave"}, "m2": {"role": "slave"}, **other}}
        )
