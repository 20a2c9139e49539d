"""Certificates of logs of every kind: other laws, gaps, old versions, torn and empty files."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import trilat_net
from tests.analysis.builders import (
    find_relative_residual,
    make_busy_run,
    make_run,
    make_short_log,
)
from tests.log.builders import replace_fields, rewrite_log
from trilat_net.analysis.certificate.functional_judgements import JUDGEMENTS
from trilat_net.analysis.certificate.stability_certificate import Certificate
from trilat_net.analysis.certificate.verdict_facts import (
    RecordGap,
    StabilityFinding,
    StabilityVerdict,
)
from trilat_net.analysis.run_end import EndBehaviour, Stability
from trilat_net.errors import LogError
from trilat_net.log.log_reader import Log
from trilat_net.presentation.verdict_text import RECORD_GAPS
from trilat_net.scenario import load_scenario

GOLDEN = sorted((Path(__file__).parents[2] / "golden").glob("v*.mcap"))


@pytest.mark.parametrize("path", GOLDEN, ids=lambda path: path.stem)
def test_every_released_version_is_certified(path: Path) -> None:
    certificate = Certificate.of_log(trilat_net.open_log(path))
    assert certificate.balance is not None
    assert certificate.verdict.finding in (StabilityFinding.COVERED, StabilityFinding.ROSE)
    assert np.abs(certificate.balance.unexplained).max() <= 1e-3 * certificate.balance.scale


@pytest.mark.parametrize(
    ("d", "motion", "stability"),
    [
        (0.2, EndBehaviour.DIVERGED, Stability.NOT_STABLE),
        (3.0, EndBehaviour.DECAYS, Stability.OPEN),
    ],
)
def test_growth_alone_judges_laws_without_functional(
    d: float, motion: EndBehaviour, stability: Stability
) -> None:
    """Records alone prove no such run stable."""
    law = {
        "control.law": "p_d",
        "control.K": 10.0,
        "control.d": d,
        "duration_s": 20.0,
        "rate_hz": 100,
    }
    certificate = Certificate.of_log(trilat_net.simulate(load_scenario("free", law)))
    assert certificate.verdict.finding is StabilityFinding.NOT_JUDGED
    assert (
        certificate.verdict.text == "V cannot be judged: m1, m2, s: law p_d has no functional V"
    )
    assert certificate.end.behaviour is motion
    assert certificate.stability is stability


def make_arm_external(log: Log, *, known: bool) -> Log:
    """Returns the same records, of a slave with an external arm."""
    spec = log.scenario.sites["s"]
    arm = msgspec.structs.replace(spec.arm, known=known)
    sites = {
        **log.scenario.sites,
        "s": msgspec.structs.replace(spec, plant="external", arm=arm),
    }
    log.scenario = msgspec.structs.replace(log.scenario, sites=sites)
    return log


def make_free_log() -> Log:
    return rewrite_log(
        make_run("free", {"duration_s": 2.0, "rate_hz": 200}).log, lambda _: True
    )


def test_an_arm_with_unknown_theta_has_no_v() -> None:
    certificate = Certificate.of_log(make_arm_external(make_free_log(), known=False))
    assert certificate.verdict.finding is StabilityFinding.NOT_JUDGED
    assert (
        certificate.verdict.text
        == "V cannot be judged: s: theta of the arm is unknown, and V depends on it"
    )


def test_external_arms_are_judged_with_identified_theta() -> None:
    as_told = Certificate.of_log(make_arm_external(make_free_log(), known=True))
    assert as_told.verdict.finding is StabilityFinding.COVERED
    assert "no record says who pushes the arm of s" in as_told.verdict.text
    change = lambda s: replace_fields(s, qd=[1.1 * x for x in s.qd]) if s.site == "s" else s  # noqa: E731
    certificate = Certificate.of_log(
        make_arm_external(rewrite_log(make_free_log(), change=change), known=True)
    )
    assert certificate.verdict.finding is StabilityFinding.NOT_JUDGED
    assert (
        "the external arm of s does not move according to its theta" in certificate.verdict.text
    )


def test_a_record_without_neighbours_is_no_period() -> None:
    certificate = Certificate.of_log(
        rewrite_log(make_free_log(), lambda state: state.tick % 2 == 0)
    )
    assert certificate.verdict.text == f"V cannot be judged: {RECORD_GAPS[RecordGap.NO_PERIOD]}"


def test_a_period_too_long_is_not_judged() -> None:
    """M of 1 g at the end of link 2, Kp = 1: its time constant is 1 ms, the period 3 ms."""
    light = {
        "arm.m2_kg": 0.001,
        "rate_hz": 333,
        "duration_s": 2.0,
        "limits.qd_limit_rad_s": 100.0,
    }
    certificate = Certificate.of_log(trilat_net.simulate(load_scenario("two_sites", light)))
    assert certificate.verdict.finding is StabilityFinding.NOT_JUDGED
    assert "the period is too long for these gains" in certificate.verdict.text


def test_gaps_are_left_out_and_reported() -> None:
    whole = make_run("free", {"duration_s": 4.0, "rate_hz": 200, "link.delay_ms": 150.0}).log
    log = rewrite_log(whole, lambda state: not (state.site == "m1" and 200 <= state.tick < 240))
    certificate = Certificate.of_log(log)
    assert certificate.balance is not None
    assert certificate.verdict.finding is StabilityFinding.COVERED
    assert certificate.verdict.text.startswith(
        "covered by the theorem, as far as the log tells: V did not rise: "
    )
    assert "not judged: 0.995 to 1.35 s" in certificate.verdict.text
    work = sum(np.abs(x).max() for x in certificate.balance.work.values())
    assert work <= 1e-6  # nobody is said to have given what changed in the gap
    assert find_relative_residual(certificate.balance) <= 1e-3
    # s looks back by 150 ms
    assert certificate.balance.unjudged_spans == [pytest.approx((0.995, 1.35))]


def test_a_gap_does_not_break_the_balance() -> None:
    """Events within a gap are nobody's fault."""
    whole = make_run("free", {"duration_s": 4.0, "rate_hz": 100}).log
    for site in whole.sites:
        certificate = Certificate.of_log(
            rewrite_log(whole, lambda s, site=site: not (s.site == site and 25 <= s.tick < 225))
        )
        assert certificate.verdict.finding is not StabilityFinding.BROKEN


def test_an_unfinished_log_is_judged_to_its_end() -> None:
    whole = make_run("free", {"duration_s": 4.0, "rate_hz": 200}).log
    certificate = Certificate.of_log(
        rewrite_log(whole, lambda state: 200 < state.tick < 700, finished=False)
    )
    assert certificate.balance is not None
    assert certificate.verdict.finding is StabilityFinding.COVERED
    # what is under way then was sent since the first record
    assert certificate.balance.t_s[0] == pytest.approx(1.205)
    assert find_relative_residual(certificate.balance) <= 1e-3


@pytest.mark.parametrize("ticks", [0, 1])
def test_nearly_empty_logs_are_reported(ticks: int) -> None:
    certificate = Certificate.of_log(
        rewrite_log(make_short_log("paper"), lambda state: state.tick < ticks)
    )
    assert (
        certificate.verdict.text
        == f"V cannot be judged: {RECORD_GAPS[RecordGap.NO_COMMON_TIME]}"
    )
    assert certificate.end.behaviour is EndBehaviour.UNDECIDED
    assert not certificate.passed


def test_two_records_are_a_period() -> None:
    certificate = Certificate.of_log(
        rewrite_log(make_short_log("paper"), lambda state: state.tick < 2)
    )
    assert certificate.balance is not None
    assert len(certificate.balance.t_s) == 2


def test_arms_at_rest_have_no_energy() -> None:
    """theta_hat(0) = theta and equal starts: V(0) = 0, and nothing divides by V(0)."""
    rest = {"control.theta_hat0": [3.0, 1.0, 1.0, 2.0, 1.0], "duration_s": 1.0, "rate_hz": 200}
    certificate = make_run("paper", rest).certificate
    assert certificate.balance is not None
    assert certificate.balance.V[0] == 0.0
    assert find_relative_residual(certificate.balance) <= 1e-3
    assert certificate.verdict.finding is StabilityFinding.COVERED


def test_sites_of_different_rates_are_booked_together() -> None:
    rates = {"sites.m2.rate_hz": 250, "sites.s.rate_hz": 350, "rate_hz": 500, "duration_s": 4.0}
    certificate = make_run("asymmetric", rates).certificate
    assert certificate.balance is not None
    assert len(certificate.balance.t_s) == pytest.approx(2000, abs=5)
    assert find_relative_residual(certificate.balance) <= 2e-4
    assert certificate.verdict.finding in (StabilityFinding.DID_NOT_RISE, StabilityFinding.ROSE)


def test_a_command_is_booked_like_scripted_changes() -> None:
    certificate = Certificate.of_log(make_busy_run().log)
    assert certificate.balance is not None
    assert find_relative_residual(certificate.balance) <= 5e-3
    assert certificate.verdict.finding is not StabilityFinding.BROKEN


def test_an_unreadable_change_is_a_log_error() -> None:
    change = lambda s: replace_fields(s, cmd=["{}"] if s.tick == 5 else [])  # noqa: E731
    with pytest.raises(LogError, match="a command that cannot be read"):
        Certificate.of_log(rewrite_log(make_short_log("paper"), change=change))


def judge_unexplained(
    error_share: float, uncertain_share: float, scale_j: float
) -> StabilityVerdict | None:
    """Returns the verdict on the balance of one site with the given unexplained energy."""
    course = scale_j * error_share * np.array([0.0, -0.5, -1.0, 1.0])
    energy = SimpleNamespace(
        unexplained=course,
        uncertainty=scale_j * uncertain_share,
        followed={},
        motion=SimpleNamespace(records=SimpleNamespace(t_s=np.arange(4.0))),
    )
    run: Any = SimpleNamespace(
        energies={"s": energy},
        balance=SimpleNamespace(scale=scale_j),
        log=SimpleNamespace(scenario=SimpleNamespace(external=())),
    )
    return JUDGEMENTS[0](run, ())


@given(
    st.sampled_from([0.0, 1e-4, 4e-4, 1.5e-3, 2e-2]),
    st.sampled_from([0.0, 1e-5, 3e-4, 2e-3]),
    st.sampled_from([1e-4, 1e-2, 1e2, 1e4]),
)
def test_broken_balances_have_no_unit_of_energy(
    error_share: float, uncertain_share: float, scale_j: float
) -> None:
    """A verdict on unexplained energy depends on its share of V, and not on V itself."""
    of_unit = judge_unexplained(error_share, uncertain_share, 1.0)
    scaled = judge_unexplained(error_share, uncertain_share, scale_j)
    assert (of_unit is None) == (scaled is None)
    if of_unit is not None and scaled is not None:
        assert scaled.finding is of_unit.finding is StabilityFinding.BROKEN
        expected = of_unit.facts._replace(
            error_j=pytest.approx(scale_j * error_share), scale_j=scale_j
        )
        assert scaled.facts == expected


def test_unexplained_energy_is_certain_if_known_well() -> None:
    """Unexplained energy is certain only if large, and if the energies are known well."""
    shares = {(1e-4, 0.0): None, (4e-4, 0.0): False, (2e-2, 1e-5): True, (2e-2, 2e-3): False}
    for (error_share, uncertain_share), is_certain in shares.items():
        verdict = judge_unexplained(error_share, uncertain_share, 100.0)
        assert (verdict.facts.is_certain if verdict else None) is is_certain
