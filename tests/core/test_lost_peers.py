"""`on_lost = "degrade"`: a lost master's share goes to the others, and comes back with it."""

import functools
from typing import Any

import numpy as np
import pytest

import trilat_net
from tests.core.guarded_runs import list_reasons
from tests.execution.builders import make_trajectories, sample_records
from trilat_net.analysis.certificate.energy_balance import EnergyBalance, SiteEnergy
from trilat_net.analysis.dominance_history import DominanceHistory, PeerLoss
from trilat_net.core.links.lost_peers import BACK_NS
from trilat_net.core.step.ticks import LifeReason
from trilat_net.errors import ScenarioError
from trilat_net.execution.verification import verify_log
from trilat_net.execution.virtual_comparison import compare_with_virtual
from trilat_net.log.log_reader import Log
from trilat_net.scenario import Scenario, load_scenario

RULE = {
    "on_stale.action": "glide",
    "on_stale.on_lost": "degrade",
    "on_stale.align_limit_rad": 2.0,
}


def make_cut_scenario(*cuts: str, **more: Any) -> Scenario:
    """Returns the paper's scenario with a delay of 100 ms; cut links lose samples stamped from
    3 s to 4 s.
    """
    outages = {f"links.{cut}.outages_s": [[3.0, 4.0]] for cut in cuts}
    return load_scenario(
        "paper", {**RULE, "duration_s": 6.0, "link.delay_ms": 100.0, **outages, **more}
    )


@functools.cache
def make_master_lost_log() -> Log:
    """Returns a run in which no site hears m1 for a second."""
    return trilat_net.simulate(make_cut_scenario("m1->s", "m1->m2"))


def test_lost_masters_shares_go_over_and_return() -> None:
    """The last sample before the cut comes into use at 3.099 s, the first after it at 4.1 s."""
    log = make_master_lost_log()
    part = log["s"]
    other = log["m2"]
    modes = list_reasons(log, "s")[-4:]
    assert modes == [
        ("return", LifeReason.DROPPED),
        ("run", LifeReason.ALIGNED),
        ("return", LifeReason.RESTORED),
        ("run", LifeReason.ALIGNED),
    ]
    starts = np.flatnonzero((part.mode[1:] == "return") & (part.mode[:-1] == "run")) + 1
    assert starts.tolist() == [3120, 4100 + BACK_NS // 1_000_000]
    assert (part.q_des[3500:4350] == other.q[3400:4250]).all()  # m2 alone
    shares = DominanceHistory.of_log(log, "s", part.t_s).alpha
    assert np.abs(shares.sum(axis=1) - 1.0).max() == 0.0
    assert (shares[3500] == [0.0, 1.0]).all()
    assert (shares[-1] == shares[0]).all()
    assert "hold" not in {mode for site in log.sites for mode in log[site].mode}
    assert set(log["m1"].mode[400:]) == {"run"}  # it hears everybody


def test_losing_a_master_never_jumps_the_reference() -> None:
    part = make_master_lost_log()["s"]
    h_s = 1e-3
    stale = slice(3099, 3120)  # what is in use stays meanwhile, and so does its rate
    steps = np.diff(part.q_des, axis=0) - 0.5 * h_s * (part.qd_des[1:] + part.qd_des[:-1])
    steps[stale] = 0.0
    assert np.abs(steps).max() <= 1e-6
    assert np.abs(np.diff(part.qd_des, axis=0)).max() <= 0.03


@pytest.mark.long
def test_degraded_runs_verify_and_close_their_energies() -> None:
    log = make_master_lost_log()
    assert verify_log(log).identical == 18_000
    assert compare_with_virtual(log).fed.identical == 18_000
    plan = make_cut_scenario("m1->s", "m1->m2")
    ticks = make_trajectories(plan)
    fused = sample_records(plan, (6.0,))[:, 0]
    columns = plan.layout("s").columns()
    for site, row in zip(ticks.sites.values(), fused, strict=True):
        assert all(
            (getattr(site, name)[-1] == row[columns[name]]).all()
            for name in ("q", "tau", "q_des")
        )
    balance = EnergyBalance.of_energies(SiteEnergy.by_site(log))
    assert np.abs(balance.residual).max() <= 1e-4 * np.abs(balance.V).max()
    losses = [
        (site, peer, round(a, 2), round(b, 2)) for site, peer, a, b in PeerLoss.list_of_log(log)
    ]
    assert losses == [("m2", "m1", 3.12, 4.35), ("s", "m1", 3.12, 4.35)]
    (premise,) = (
        premise_found
        for premise_found in trilat_net.certify(log).premises
        if premise_found.name == "shares"
    )
    assert "s without m1 3.12 to 4.35 s; the remaining sites follow each other" in premise.text


def test_the_last_master_and_slave_are_awaited() -> None:
    for cuts in (("m1->s", "m2->s"), ("s->m1", "s->m2")):
        log = trilat_net.simulate(make_cut_scenario(*cuts, duration_s=5.0))
        for site in {cut.partition(">")[2] for cut in cuts}:
            held = log[site].mode == "hold"
            assert held[3120:4100].all()
            assert log[site].mode[-1] == "run"
        assert PeerLoss.list_of_log(log) == []


def test_indispensable_peers_are_never_dropped() -> None:
    """m2 follows m1 alone: without m1 it would follow nobody, and an arm that stands still would lead s."""
    chain = {"dominance.m2": {"m1": 1.0}, "dominance.m1": {"m2": 0.5, "s": 0.5}}
    log = trilat_net.simulate(make_cut_scenario("m1->s", duration_s=5.0, **chain))
    assert (log["s"].mode[3120:4100] == "hold").all()
    assert PeerLoss.list_of_log(log) == []


@pytest.mark.parametrize(
    ("name", "overrides", "phrase"),
    [
        ("two_sites", RULE, "no site can go on without a master"),
        ("paper", {"on_stale.on_lost": "degrade"}, "needs on_stale.action = 'glide'"),
        ("paper", {**RULE, "on_stale.on_lost": "drop"}, "'hold' or 'degrade'"),
    ],
)
def test_an_impossible_rule_is_refused(
    name: str, overrides: dict[str, Any], phrase: str
) -> None:
    with pytest.raises(ScenarioError, match=phrase):
        load_scenario(name, overrides)
