"""Energies that laws declare (lines, stores and losses), judged from the records.

Energies of the built-in laws that account for them, as the certificate books them from records
alone.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from trilat_studies.tuning.tuning_report import TuningReport

from tests.energy_runs import CONSTANT, FOLLOWER, JITTER, LAWS, make_energy_pair
from tests.log.builders import drop_records, edit_log_bytes, make_log_bytes, open_bytes
from tests.scenario.builders import make_scenario
from tests.unit_arm import make_spring_hand, make_unit_scenario
from trilat_net.analysis.certificate.observed_energy import ObservedEnergy
from trilat_net.analysis.certificate.stability_certificate import Certificate
from trilat_net.analysis.run_end import Stability
from trilat_net.errors import LogError
from trilat_net.execution.virtual import SimulatedLog
from trilat_net.files import find_page
from trilat_net.log.log_reader import Log
from trilat_net.presentation.certificate_text import describe_certificate
from trilat_net.presentation.figures.registry import figure
from trilat_net.presentation.observed_text import NEGATIVE_ENERGY_MEANING
from trilat_net.scenario import load_scenario

B = 10.0
DELAY_S = 0.05
TO = 0.3
HAND = 50.0
WALL = 1000.0
PAIR = f"""
name = "line"
scheme = "digital"
duration_s = 8.0
[control]
law = "tests.line_law:Line"
[link]
delay_ms = {1000 * DELAY_S}
[dominance.m]
s = 1.0
[dominance.s]
m = 1.0
[[sites.m.hands]]
kind = "spring"
to_rad = [{TO}, {TO}]
move_start_s = 0.5
move_end_s = 2.0
stiffness_nm_rad = {HAND}
damping_nm_s_rad = 10.0
[sites.s]
role = "slave"
[[sites.s.hands]]
kind = "spring"
stiffness_nm_rad = {WALL}
damping_nm_s_rad = 10.0
"""


@cache
def simulate_clamped_pair(**changes: Any) -> Log:
    """Returns the log of a master that a hand moves, a line, and a clamped slave."""
    return SimulatedLog(make_scenario(load_scenario(PAIR), **changes))


def test_a_line_at_rest_is_a_spring() -> None:
    """The spring b / T lies between the hand and the clamp of the slave: its energy is half its
    force squared times T / b.
    """
    log = simulate_clamped_pair()
    energies = ObservedEnergy.of_log(log, own_laws=True)
    assert energies.finding == "passive"
    assert all(premise.holds for premise in energies.premises)
    assert {energy.name for energy in energies.least} >= {"line m->s", "line s->m"}
    assert min(energy.amount_j for energy in energies.least) >= -1e-12
    assert energies.residual_j <= 1e-12 * energies.largest_j
    force = TO / (1 / HAND + DELAY_S / B + 1 / WALL)  # of each of two joints
    assert log["m"].tau_x[-1] == pytest.approx([-force, -force], rel=2e-3)
    waves = [log[site].sent[f"u[{peer}]"][-1] for site, peer in (("m", "s"), ("s", "m"))]
    stored = sum(0.5 * DELAY_S * (wave**2).sum() for wave in waves)
    assert stored == pytest.approx(force**2 * DELAY_S / B, rel=5e-3)


def test_waves_held_over_an_outage_add_energy() -> None:
    """The wave of a missing sample must be zero (Niemeyer and Slotine 2004); this law uses the
    last wave again and again.

    The hand lets go in the outage, so that the master sends less than the slave goes on using.
    """
    outage = {"links__m->s__outages_s": [[1.8, 3.0]], "sites__m__hands__0__end_s": 2.0}
    log = simulate_clamped_pair.__wrapped__(**outage, duration_s=3.2)
    certificate = Certificate.of_log(log, own_laws=True)
    assert certificate.observed.finding == "negative"
    lowest = min(certificate.observed.least, key=lambda energy: energy.amount_j)
    assert lowest.name == "line m->s"
    last = round(1000 * lowest.at_s) + 1
    used = log["s"].used["m"][:last]
    times = np.bincount(used[used >= 0], minlength=last)  # how often each wave was used
    energy = 0.5 * 1e-3 * (log["m"].sent["u[s]"][:last] ** 2).sum(axis=1)
    assert times.max() > 1000
    assert lowest.amount_j == pytest.approx(((1 - times) * energy).sum(), rel=1e-9)
    assert certificate.observed.text in certificate.reasons
    assert certificate.stability is not Stability.STABLE


def test_books_detect_a_law_sending_too_much() -> None:
    energies = ObservedEnergy.of_log(
        simulate_clamped_pair(control__boost=1.01, duration_s=2.0), own_laws=True
    )
    assert energies.finding == "broken"
    assert energies.residual_j > 1e-4


def test_a_silent_law_leaves_the_books_open() -> None:
    silent = {"sites.s.control.law": "tests.line_law:Silent", "duration_s": 0.1}
    mixed = SimulatedLog(load_scenario(simulate_clamped_pair().scenario, silent))
    assert ObservedEnergy.of_log(mixed, own_laws=True).text.endswith(
        "the law of s declares no energies"
    )


def test_own_laws_run_by_request_alone() -> None:
    """A certificate runs the code of a user's law only if its caller requests this."""
    log = SimulatedLog(load_scenario(PAIR, {"duration_s": 0.01}))
    assert ObservedEnergy.of_log(log) is None
    assert Certificate.of_log(log).observed is None
    assert Certificate.of_log(log, own_laws=True).observed is not None


def test_the_certificate_reports_it_in_text_and_json() -> None:
    certificate = Certificate.of_log(simulate_clamped_pair(), own_laws=True)
    lines = {line.text: line.mark for line in describe_certificate(certificate)}
    assert lines[certificate.observed.text] == "ok"
    observed = certificate.to_dict()["observed"]
    assert observed["finding"] == "passive"
    assert {premise["name"] for premise in observed["premises"]} == {
        "books",
        "torque",
        "sampling",
    }
    assert np.isfinite([energy["amount_j"] for energy in observed["least"]]).all()


@cache
def simulate_law(law: str) -> Log:
    """Returns the log of a law with a clamped slave and delays of 200 ms each way."""
    return SimulatedLog(make_energy_pair(LAWS[law], clamped=True, duration_s=3.0))


@pytest.mark.long
@pytest.mark.parametrize("law", LAWS)
def test_energies_of_lines_observers_and_tanks_stay_nonnegative(law: str) -> None:
    log = simulate_law(law)
    energies = ObservedEnergy.of_log(log)
    assert energies.finding == "passive"
    assert all(premise.holds for premise in energies.premises)
    assert energies.residual_j <= 1e-12 * energies.largest_j
    assert {energy.name for energy in energies.least} >= {
        "line m->s",
        "line s->m",
        "store of s",
        "taken by s",
    }
    course_given = next(curve for curve in energies.curves if curve.name == "given by m")
    work = -(log["m"].tau[:-1] * np.diff(log["m"].q, axis=0)).sum()
    assert course_given.energy_j[-1] == pytest.approx(work, rel=1e-9)
    assert work > 0.05


@pytest.mark.long
def test_a_figure_shows_energies_over_time() -> None:
    drawn = figure(simulate_law("wave"), "observed_energy")
    lines, known, stored, given_curve = drawn.axes
    assert len(lines.lines) == len(known.lines) == len(stored.lines) == 2
    assert len(given_curve.lines) == 4


@pytest.mark.long
def test_jolts_beyond_reserve_make_the_observer_negative() -> None:
    """Sites that start apart; the reserve of a scenario that names none covers such a jolt."""
    changes = {
        "control.law": "tdpa",
        "scheme": "digital",
        "duration_s": 1.0,
        "sites.s.q0_rad": [0.8, 0.5],
    }
    changes |= {"sites.m.control.K": 0.0, "sites.m.control.B": 0.0}
    covered = Certificate.of_log(SimulatedLog(load_scenario("two_sites", changes)))
    assert covered.observed.finding == "passive"
    certificate = Certificate.of_log(
        SimulatedLog(load_scenario("two_sites", {**changes, "control.reserve_J": 0.0}))
    )
    assert certificate.observed.finding == "negative"
    assert ("note", NEGATIVE_ENERGY_MEANING) in describe_certificate(certificate)
    known = next(
        energy for energy in certificate.observed.least if energy.name == "known at s of m"
    )
    assert known.amount_j < -1e-7
    assert certificate.observed.text in certificate.reasons


@pytest.mark.long
def test_leaders_velocity_makes_energy_at_slower_followers() -> None:
    """As published, the follower's damper uses a velocity that is not the follower's own."""
    law = {**LAWS["tdpa"], "energy": "velocity", "reserve_J": 0.0, "acceleration_rad_s2": 0.0}
    log = SimulatedLog(make_energy_pair(law, clamped=False, duration_s=4.0))
    energies = ObservedEnergy.of_log(log)
    taken = next(energy for energy in energies.least if energy.name == "taken by s")
    assert energies.finding == "negative"
    assert taken.amount_j < -1e-3


@pytest.mark.long
@pytest.mark.parametrize("law", LAWS)
def test_torque_cut_by_the_limit_is_booked(law: str) -> None:
    """The hand holds the master where its spring gives 1.5 N m."""
    limits = {"tau_limit_nm": 1.5, "qd_limit_rad_s": 1e3}
    log = SimulatedLog(make_energy_pair(LAWS[law], clamped=True, duration_s=6.0, limits=limits))
    energies = ObservedEnergy.of_log(log)
    assert energies.finding == "passive"
    assert next(
        premise for premise in energies.premises if premise.name == "torque"
    ).text.startswith("cut off at m")
    assert np.abs(log["m"].tau).max() == 1.5


@pytest.mark.long
@pytest.mark.parametrize("law", ["wave", pytest.param("tdpa", marks=pytest.mark.long)])
@pytest.mark.parametrize(
    "link",
    [
        pytest.param(CONSTANT, id="constant", marks=pytest.mark.long),
        pytest.param(JITTER, id="jitter"),
    ],
)
def test_weighted_torques_keep_the_weighted_energy(law: str, link: dict[str, Any]) -> None:
    shares = {
        "m1": {"m2": 0.1, "s": 0.9},
        "m2": {"m1": 0.4, "s": 0.6},
        "s": {"m1": 0.8, "m2": 0.2},
    }
    control = {**LAWS[law], **FOLLOWER}
    sites = {
        "m1": {"hands": [make_spring_hand(0.3)]},
        "m2": {"hands": [make_spring_hand(-0.3)]},
        "s": {},
    }
    for name, beta in (("m2", 0.5), ("s", 1.5)):
        sites[name]["control"] = {**control, "beta": beta}
    scenario = make_unit_scenario(sites, control, duration_s=8.0, dominance=shares, link=link)
    energies = ObservedEnergy.of_log(SimulatedLog(scenario))
    assert energies.finding == "passive"
    assert all(premise.holds for premise in energies.premises)


@pytest.mark.parametrize("mem", [[], [0.0] * 4])
def test_missing_law_memory_in_records_is_reported(mem: list[float]) -> None:
    data = make_log_bytes(
        "two_sites", {"control.law": "tanks", "duration_s": 0.1, "scheme": "digital"}
    )
    broken = edit_log_bytes(
        data, record=lambda r: {**r, "mem": mem} if (r["site"], r["tick"]) == ("s", 40) else r
    )
    assert ObservedEnergy.of_log(open_bytes(data)).curves
    with pytest.raises(LogError, match="a record of s does not have"):
        ObservedEnergy.of_log(open_bytes(broken))


def test_three_texts_explain_negative_energy_alike() -> None:
    """The certificate, `compare --tune` and the page of the laws."""
    page = find_page("laws-tdpa.md").read_text(encoding="utf-8")
    assert NEGATIVE_ENERGY_MEANING in " ".join(page.split())
    tuned: Any = SimpleNamespace(
        found=[SimpleNamespace(space=SimpleNamespace(law=law)) for law in ("p_d", "tdpa")]
    )
    (note,) = TuningReport(tuned).list_energy_notes()
    assert note.startswith("tdpa declare")
    assert note.endswith(NEGATIVE_ENERGY_MEANING)
    tuned.found.pop()
    assert TuningReport(tuned).list_energy_notes() == []


def test_a_complete_brief_run_satisfies_all_premises() -> None:
    """No torque of the run is at its limit, so that no work is missing from the books."""
    log = SimulatedLog(load_scenario(PAIR, {"duration_s": 0.05}))
    energies = ObservedEnergy.of_log(log, own_laws=True)
    assert {premise.name: premise.holds for premise in energies.premises} == {
        "books": True,
        "torque": True,
        "sampling": True,
    }


BRIEF_TANKS = {"control.law": "tanks", "duration_s": 0.1, "scheme": "digital"}


@pytest.mark.parametrize("ticks", [{40}, {0}, {0, 40}])
def test_lost_records_leave_the_energies_unjudged(ticks: set[int]) -> None:
    """Sums since the start of a run need every record from the first one on."""
    data = make_log_bytes("two_sites", BRIEF_TANKS)
    energies = ObservedEnergy.of_log(
        open_bytes(edit_log_bytes(data, record=drop_records("s", ticks)))
    )
    assert energies.finding == "not_judged"
    assert energies.incomplete_sites == ("s",)


def test_uncounted_energy_begins_at_zero() -> None:
    """The potential energy of raised arms at the start is no energy that they gave."""
    raised = {f"sites.{site}.q0_rad": [0.8, 0.5] for site in ("m", "s")}
    log = open_bytes(make_log_bytes("two_sites", {**BRIEF_TANKS, **raised}))
    assert all(log.scenario.setup(site).theta_known for site in log.sites)
    energies = ObservedEnergy.of_log(log)
    assert 0.0 <= energies.sampling_j < 1e-3 * energies.largest_j + 1e-6
