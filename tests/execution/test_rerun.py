"""Sites of a log executed again: without changes the rerun equals the log; with a change, that
experiment.
"""

from pathlib import Path

import pytest
from hypothesis import given, settings

import trilat_net
from tests.execution.builders import all_identical, list_tick_results
from tests.execution.deliveries import (
    SITES,
    TICKS,
    Sample,
    make_delivered_bytes,
    never,
    site_sets,
    under_way,
)
from tests.log.builders import edit_log_bytes, make_log, make_log_bytes, open_bytes
from trilat_net.core.step.fingerprint import compute_fingerprint
from trilat_net.core.step.site_step import Site
from trilat_net.core.step.ticks import Arrival, TickInput
from trilat_net.execution.verification import TOLERANCE, equal_record
from trilat_net.execution.what_if import rerun
from trilat_net.scenario import list_shipped, load_scenario

GOLDEN = sorted((Path(__file__).parents[1] / "golden").glob("v*.mcap"))
SHORT = {"duration_s": 0.12, "link.delay_ms": 20.0}


@pytest.mark.parametrize("name", list_shipped())
@pytest.mark.parametrize(
    "scheme", ["second_order", pytest.param("digital", marks=pytest.mark.long)]
)
def test_an_unchanged_rerun_equals_the_log_bitwise(name: str, scheme: str) -> None:
    log = make_log(name, {"duration_s": 0.3, "scheme": scheme})
    for site in log.sites:
        assert all_identical(rerun(log, [site]))
    assert all_identical(rerun(log, closed_loop=True))


def test_reruns_of_different_rates_equal_the_log() -> None:
    rates = {"sites.m1.rate_hz": 1000, "sites.m2.rate_hz": 700, "sites.s.rate_hz": 333}
    log = make_log("paper", {**rates, **SHORT})
    for replace in (["m2"], ["m2", "s"], list(SITES)):
        assert all_identical(rerun(log, replace))


@pytest.mark.parametrize("path", GOLDEN, ids=lambda path: path.stem)
@pytest.mark.parametrize(
    "replace", [["m1"], ["m2"], ["s"], ["m2", "s"], ["m1", "m2", "s"]], ids=" ".join
)
def test_reruns_of_every_log_version_are_equal(path: Path, replace: list[str]) -> None:
    again = rerun(path, replace)
    assert not again.request.changes
    assert not again.broken
    if again.before.session["fingerprint"] == compute_fingerprint():
        assert all_identical(again)
        return
    assert any("fingerprint" in note or "arithmetic" in note for note in again.notes), (
        again.notes
    )
    for site in replace:
        for field in ("q", "qd", "tau", "theta_hat"):
            ours = getattr(again.after[site], field)
            theirs = getattr(again.before[site], field)
            assert abs(ours - theirs).max() <= 1e3 * TOLERANCE * (1 + abs(theirs).max())


@settings(max_examples=15)
@given(delays=under_way, lost=never, replace=site_sets)
def test_recorded_delivery_is_repeated_exactly(
    delays: dict[Sample, int], lost: frozenset[Sample], replace: list[str]
) -> None:
    assert all_identical(rerun(open_bytes(make_delivered_bytes(delays, lost)), replace))


def test_a_changed_site_sees_recorded_samples() -> None:
    """A site of the changed scenario, stepped by hand, receives the samples that its records list."""
    log = open_bytes(
        make_delivered_bytes(
            {("s", 0, 40): 37, ("s", 1, 41): 25, ("s", 1, 60): 12}, {("s", 0, 70)}
        )
    )
    changes = {
        "sites.s.control.Kd": 7.0,
        "links.m1->s.delay_ms": 11.0,
        "sites.s.q0_rad": [0.2, -0.1],
    }
    again = rerun(log, ["s"], changes)
    site = Site(load_scenario(log.scenario, changes).setup("s"))
    samples = [{state.tick: state for state in log[peer].states} for peer in site.peers]
    for state, record in zip(log["s"].states, again.after["s"].states, strict=True):
        arrivals = [
            Arrival(j, m, samples[j][m].q, samples[j][m].qd, us) for j, m, us in state.rx
        ]
        assert equal_record(record, site.step(TickInput(state.tick, arrivals)), site.peers)
    assert again.sites["s"].first is not None
    assert not again.identical
    assert not again.broken


@pytest.mark.parametrize(
    "changes",
    [
        {"control.Kd": 5.0},
        {"control.law": "p_d", "control.K": 20.0},
        {"link.delay_ms": 33.0},
        {
            "link.model": "uniform",
            "link.delay_ms": 20.0,
            "link.half_width_ms": 15.0,
            "link.loss": 0.2,
        },
        {"link.playout_ms": 45.0},
        {"arm.m2_kg": 2.5, "limits.tau_limit_nm": 12.0},
        {"dominance.s.m1": 0.9, "dominance.s.m2": 0.1},
        {"scheme": "digital", "sites.m1.q0_rad": [0.4, 0.1]},
        {"duration_s": 0.05},
        {"rate_hz": 500},
        {"sites.m1.rate_hz": 700, "sites.s.rate_hz": 1500},
        {"on_stale.action": "hold", "on_stale.age_ms": 25.0, "link.outages_s": [[0.03, 0.06]]},
    ],
    ids=lambda changes: " ".join(changes),
)
def test_closed_loop_changes_equal_the_changed_experiment(
    changes: dict[str, object],
) -> None:
    """If every sample comes long before it is due, the network does not matter (L2)."""
    again = rerun(make_log("free"), [], changes, closed_loop=True)
    twin = make_log("free", {**SHORT, **changes})
    for site in SITES:
        ours = list_tick_results(again.after, site)
        theirs = list_tick_results(twin, site)
        assert ours == theirs[: len(ours)]
        # rates that do not divide: up to the last record of the log
        assert len(ours) >= len(theirs) - 2


def test_longer_delays_make_late_samples_harmless() -> None:
    log = open_bytes(
        make_delivered_bytes({("m2", 1, 40): 25, ("s", 0, 50): 31, ("s", 1, 51): 30})
    )
    again = rerun(log, [], {"link.delay_ms": 31.0}, closed_loop=True)
    twin = make_log("free", {"duration_s": 0.12, "link.delay_ms": 31.0})
    assert all(
        list_tick_results(again.after, site) == list_tick_results(twin, site) for site in SITES
    )


def test_on_measured_links_only_arrivals_count() -> None:
    log = open_bytes(make_delivered_bytes({("s", j, m): 9 for j in (0, 1) for m in range(120)}))
    again = rerun(log, ["s"], {"link.model": "measured"})
    assert (again.links["m1->s"].age_mean_ms, again.links["m1->s"].age_max_ms) == (
        (20.0, 9.0),
        (20.0, 9.0),
    )


def test_only_executed_sites_react() -> None:
    """If m1 moves otherwise, an executed s sees the change 20 ms later, and no other site does."""
    log = make_log("free")
    stiff = {"sites.m1.control.Kd": 9.0}
    alone = rerun(log, ["m1"], stiff)
    both = rerun(log, ["m1", "s"], stiff)
    assert list_tick_results(alone.after, "s") == list_tick_results(log, "s")
    assert alone.after["s"].payloads[50] == log["s"].payloads[50]
    assert list_tick_results(both.after, "s")[:20] == list_tick_results(log, "s")[:20]
    assert list_tick_results(both.after, "s")[30:] != list_tick_results(log, "s")[30:]
    assert list_tick_results(alone.after, "m1")[:40] == list_tick_results(both.after, "m1")[:40]
    assert list_tick_results(alone.after, "m1")[60:] != list_tick_results(both.after, "m1")[60:]


def test_a_diverging_site_stops_and_is_reported() -> None:
    log = make_log("free")
    again = rerun(log, ["s", "m1"], {"sites.s.limits.qd_limit_rad_s": 0.3})
    effect = again.sites["s"]
    assert effect.diverged_at_s is not None
    assert effect.executed == round(1000 * effect.diverged_at_s) + 1 < TICKS
    assert again.diverged
    assert again.after["s"].states[-1].mode == "diverged"
    assert "diverged" in {event.kind for event in again.after.events if event.member == "s"}
    assert again.sites["m1"].executed <= effect.executed  # the run ends there
    assert len(again.after["m2"]) == TICKS


def test_diverged_logs_are_executed_to_their_end() -> None:
    log = make_log("free", {"duration_s": 1.0, "limits.qd_limit_rad_s": 0.3})
    for replace in (["m1"], list(SITES)):
        again = rerun(log, replace)
        assert all_identical(again)
        assert not again.diverged  # it is not what the rerun did
    assert not rerun(log, SITES, {"limits.qd_limit_rad_s": 100.0}).diverged


@pytest.mark.parametrize(
    "change",
    [
        lambda r: r["rx"].append([7, 3, 0]),
        lambda r: r["rx"].append([-1, 3, 0]),
        lambda r: r["rx"].append([0, 2**58, 0]),
        lambda r: r["rx"].append([0, -5, 0]),
        lambda r: r["rx"].insert(0, [1, r["tick"] + 9, 0]),  # of a tick that needs this one
        lambda r: r.update(rx=r["rx"] * 3000),
    ],
    ids=[
        "no peer",
        "before the first peer",
        "far ahead",
        "before the epoch",
        "from the future",
        "too many",
    ],
)
def test_unusual_arrivals_end_nothing(change: object) -> None:
    def record(r: dict[str, object]) -> dict[str, object]:
        if r["site"] == "s" and r["tick"] in (50, 51):
            change(r)
        return r

    log = open_bytes(edit_log_bytes(make_log_bytes("paper"), record=record))
    for replace in (["s"], list(SITES)):
        for changes in ({}, {"control.Kd": 5.0}):
            assert rerun(log, replace, changes).sites["s"].executed >= 60


def test_facts_are_plain_with_units() -> None:
    facts = rerun(make_log("free"), ["s"], {"sites.s.control.Kd": 5.0}).to_dict()
    assert facts["mode"] == "open loop"
    assert facts["changes"] == [
        {"key": "sites.s.control.Kd", "before": (3.0, 3.0), "after": (5.0, 5.0)}
    ]
    site = facts["sites"]["s"]
    assert site["error_rms_rad"].keys() == {"before", "after"}
    assert site["q_max_rad"] > site["q_rms_rad"] > 0.0
    assert site["first"]["field"] == "tau[0]"


def test_the_package_offers_reruns(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(make_log_bytes("paper"))
    again = trilat_net.rerun(path, replace="s", set={"control.Kd": 5})
    assert again.sites["s"].compared == TICKS
    assert str(again) == repr(again)
    assert "s" in repr(again)
    assert len(repr(again)) < 200
