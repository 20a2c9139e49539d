"""The verdict: covered, outside the theorem without a rise, a rise with its cause, and logs
whose balance is broken.

The evidence of a certificate: records that are missing, changed, or from no site.
"""

from collections.abc import Callable
from dataclasses import replace

import msgspec
import numpy as np
import pytest

import trilat_net
from tests.analysis.builders import EXPERT, JITTER, make_run
from tests.log.builders import (
    drop_records,
    edit_log_bytes,
    make_log_bytes,
    open_bytes,
    replace_fields,
    rewrite_log,
)
from tests.log.surgery import take_apart
from tests.scenario.builders import make_overrides
from trilat_net.analysis.certificate.stability_certificate import Certificate
from trilat_net.analysis.certificate.verdict_facts import StabilityFinding
from trilat_net.analysis.run_end import EndBehaviour, Stability
from trilat_net.analysis.stability_decision import LoopRoots
from trilat_net.log.log_reader import Log
from trilat_net.net.messages import State
from trilat_net.scenario import parse_scenario

SHORT = {"duration_s": 4.0, "rate_hz": 200}


def simulate_free(**overrides: object) -> Log:
    """Returns the log of a short run of `free`."""
    return make_run("free", {**SHORT, **make_overrides(**overrides)}).log


def test_free_motion_is_covered() -> None:
    free_certificate = Certificate.of_log(simulate_free())
    assert free_certificate.verdict.finding is StabilityFinding.COVERED
    assert free_certificate.verdict.text.startswith(
        "covered by the theorem: V did not rise: 29.78 J at 0 s, 12"
    )
    assert free_certificate.bounded_by_v
    assert free_certificate.stability is Stability.OPEN
    assert not free_certificate.passed


def test_hands_are_named_and_excused() -> None:
    certificate = make_run("paper", {"duration_s": 12.5, "rate_hz": 100}).certificate
    assert certificate.verdict.finding is StabilityFinding.COVERED
    assert (
        "covered by the theorem: V rose by no more than the hands supplied: 24 J"
        in certificate.verdict.text
    )


def test_outside_the_theorem_without_a_rise() -> None:
    certificate = make_run("wall").certificate
    assert certificate.verdict.finding is StabilityFinding.DID_NOT_RISE
    assert certificate.verdict.text.startswith(
        "the theorem does not apply (premises that fail: hands must add no energy); V rose by "
        "no more than the"
    )
    assert certificate.bounded_by_v


def test_a_rise_names_time_amount_and_cause() -> None:
    certificate = make_run("free", JITTER).certificate
    rise = certificate.verdict.rise
    assert certificate.verdict.finding is StabilityFinding.ROSE
    assert rise is not None
    assert rise.amount > 10 * certificate.verdict.tolerance
    assert sum(rise.causes.values()) >= rise.amount
    assert all("->" in cause for cause in rise.causes)
    share = 100.0 * rise.amount / certificate.balance.V.max()
    assert (
        f"V rose by {rise.amount:.3g} J ({share:.3g} % of its largest value) "
        in certificate.verdict.text
    )
    assert f"from {rise.from_s:.4g} to {rise.at_s:.4g} s" in certificate.verdict.text


def test_kd_of_different_shape_makes_v_rise() -> None:
    certificate = Certificate.of_log(
        simulate_free(sites__m1__control__Kd=[0.1, 30.0], sites__m2__control__Kd=[30.0, 0.1])
    )
    assert certificate.verdict.finding is StabilityFinding.ROSE
    assert certificate.verdict.rise is not None
    assert list(certificate.verdict.rise.causes) == ["what beta does not cancel"]


def test_sampling_feeds_a_slow_digital_loop() -> None:
    """T = 0 at 80 Hz: `digital` keeps swinging, because torques are held over a tick."""
    certificate = Certificate.of_log(
        simulate_free(rate_hz=80, scheme="digital", link__delay_ms=0.0, duration_s=20.0)
    )
    assert certificate.verdict.finding is StabilityFinding.ROSE
    assert certificate.verdict.rise is not None
    assert next(iter(certificate.verdict.rise.causes)) == "sampling"
    assert certificate.end.behaviour is not EndBehaviour.CONVERGED


def certify_changed(change: Callable[[State], State]) -> Certificate:
    return Certificate.of_log(
        rewrite_log(simulate_free(rate_hz=500, duration_s=2.0), change=change)
    )


@pytest.mark.parametrize("field", ["q", "qd", "q_des", "theta_hat"])
def test_a_changed_record_breaks_its_sites_balance(field: str) -> None:
    def change(state: State) -> State:
        late = state.site == "m2" and state.tick >= 375
        values = [1.05 * x for x in getattr(state, field)]
        return msgspec.structs.replace(state, **{field: values}) if late else state

    certificate = certify_changed(change)
    assert certificate.verdict.finding is StabilityFinding.BROKEN
    assert not certificate.passed
    assert "do not follow from the equations in the log" in certificate.verdict.text


def test_changed_records_break_balances_under_varying_delay() -> None:
    log = make_run("free", {**JITTER, "duration_s": 2.0, "rate_hz": 500}).log
    late = lambda s: s.site == "m2" and s.tick >= 500  # noqa: E731
    certificate = Certificate.of_log(
        rewrite_log(
            log, change=lambda s: replace_fields(s, q=[x + 0.01 for x in s.q]) if late(s) else s
        )
    )
    assert certificate.verdict.finding is StabilityFinding.BROKEN


def test_erased_hands_break_the_balance() -> None:
    log = make_run("paper", {"duration_s": 11.5, "rate_hz": 100}).log
    certificate = Certificate.of_log(
        rewrite_log(log, change=lambda s: msgspec.structs.replace(s, tau_x=[0.0, 0.0]))
    )
    assert certificate.verdict.finding is StabilityFinding.BROKEN
    assert "the energy of m1 does not add up" in certificate.verdict.text


FOUR = """
name = "pairs"
rate_hz = 100
duration_s = 2.0
[link]
delay_ms = 50.0
[sites.a]
role = "master"
q0_rad = [0.3, 0.0]
[sites.b]
role = "slave"
[sites.c]
role = "master"
[sites.d]
role = "slave"
q0_rad = [0.1, 0.2]
[dominance]
a = { b = 1.0 }
b = { a = 1.0 }
c = { d = 1.0 }
d = { c = 1.0 }
"""


def test_two_closed_groups_are_refused_and_named() -> None:
    certificate_found = Certificate.of_log(trilat_net.simulate(parse_scenario(FOUR)))
    assert certificate_found.verdict.finding is StabilityFinding.NOT_JUDGED
    assert (
        "{a, b} and {c, d} follow no site outside their group: beta is not unique"
        in certificate_found.verdict.text
    )
    assert certificate_found.groups == (("a", "b"), ("c", "d"))
    assert certificate_found.balance is None


def test_groups_made_by_a_change_are_refused() -> None:
    joined = FOUR.replace("c = { d = 1.0 }", "c = { d = 0.5, a = 0.5 }")
    step = '[[timeline]]\nat_s = 1.0\ndominance = "c"\nto = { d = 1.0 }\nramp_s = 0.5\n'
    assert Certificate.of_log(trilat_net.simulate(parse_scenario(joined))).balance is not None
    certificate = Certificate.of_log(trilat_net.simulate(parse_scenario(joined + step)))
    assert certificate.verdict.finding is StabilityFinding.NOT_JUDGED


def test_a_site_without_weight_converges_after_peers() -> None:
    """V does not contain m2; if only the shares fail, the motion of its peers bounds m2."""
    certificate = make_run("free", {**SHORT, **EXPERT, "duration_s": 1.0}).certificate
    assert certificate.verdict.finding is StabilityFinding.DID_NOT_RISE
    assert certificate.end.stability is Stability.OPEN
    assert certificate.bounded_by_v


def test_weightless_sites_with_other_failures_need_growth() -> None:
    hand = {
        "sites.m2.hands": [
            {"kind": "pulse", "start_s": 0.2, "end_s": 5.0, "peak_nm": [1.0, 1.0]}
        ]
    }
    certificate = make_run("free", {**SHORT, **EXPERT, **hand, "duration_s": 1.0}).certificate
    assert certificate.verdict.finding is StabilityFinding.DID_NOT_RISE
    assert not certificate.bounded_by_v
    assert not certificate.passed


def certify_rest() -> Certificate:
    """Returns a certificate of the paper's law at rest, which nothing leaves open."""
    return make_run("free", {"duration_s": 30.0, "rate_hz": 100}).certificate


def test_rest_with_falling_v_is_stable() -> None:
    assert certify_rest().stability is Stability.STABLE
    assert certify_rest().passed
    assert certify_rest().reasons == ()


def test_growth_fails_a_run_despite_v() -> None:
    grown = replace(
        certify_rest(), end=certify_rest().end._replace(behaviour=EndBehaviour.GROWS)
    )
    assert grown.stability is Stability.NOT_STABLE
    assert not grown.accepts(("bounded", "open"))


@pytest.mark.parametrize(
    ("behaviour", "accepted", "passes"),
    [
        (EndBehaviour.BOUNDED, ("bounded",), True),
        (EndBehaviour.BOUNDED, ("open",), False),
        (EndBehaviour.HARDLY, ("open",), True),
        (EndBehaviour.HARDLY, ("bounded",), False),
        (EndBehaviour.DRIFTS, ("bounded", "open"), False),
    ],
)
def test_only_accepted_outcomes_pass_besides_stable(
    behaviour: EndBehaviour, accepted: tuple[str, ...], passes: bool
) -> None:
    certificate = replace(certify_rest(), end=certify_rest().end._replace(behaviour=behaviour))
    assert not certificate.passed
    assert certificate.accepts(accepted) is passes


def test_a_broken_balance_is_never_accepted() -> None:
    certificate = certify_changed(
        lambda s: msgspec.structs.replace(s, q=[1.05 * x for x in s.q]) if s.tick > 375 else s
    )
    assert certificate.verdict.finding is StabilityFinding.BROKEN
    assert not certificate.accepts(("bounded", "open"))


def test_an_unstable_rest_never_passes_a_run() -> None:
    roots = LoopRoots("unstable", 0.012, True)
    refuted = replace(certify_rest(), roots=roots)
    assert refuted.stability is Stability.NOT_STABLE
    assert refuted.headline().endswith("rests on: exact roots, fastest growing +0.012 /s")
    doubtful = replace(certify_rest(), roots=roots._replace(exact=False))
    assert doubtful.stability is Stability.OPEN
    assert roots.text in doubtful.reasons
    assert replace(certify_rest(), roots=roots._replace(verdict="stable")).passed


def test_v_that_rises_at_the_end_is_named() -> None:
    balance = certify_rest().balance
    assert balance is not None
    t_s, V = balance.t_s, balance.unsupplied

    def growth(added: np.ndarray) -> list[str]:
        changed = replace(
            balance, parts={**balance.parts, "kinetic": balance.parts["kinetic"] + added}
        )
        return [growth.text for growth in changed.find_unsupplied_growth(1e-3)]

    assert growth(np.zeros(len(V))) == []
    assert growth(np.where(t_s < 10.0, 0.5, 0.0)) == []
    assert "V rises at the end: by 0.0" in growth(np.maximum(0.0, t_s - 20.0) * 0.01)[0]
    assert "above its beginning" in growth(np.where(t_s > 1.0, 100.0, 0.0))[0]


RUN = {"duration_s": 60.0, "rate_hz": 50, "link.delay_ms": 200.0}


def certify_bytes(data: bytes, **options: float) -> Certificate:
    return Certificate.of_log(open_bytes(data), **options)


def test_a_whole_log_is_stable_with_reasons() -> None:
    certificate = certify_bytes(make_log_bytes("free", RUN))
    assert certificate.stability is Stability.STABLE
    facts = certificate.to_dict()["evidence"]
    assert facts == {
        "coverage": 1.0,
        "functional_coverage": 1.0,
        "min_coverage": 0.999,
        "judged": {site: [3000, 3000] for site in ("m1", "m2", "s")},
        "integrity": "intact",
        "open_loop_sites": [],
    }


@pytest.mark.parametrize("cut", [range(1490, 1525), range(2965, 3000), range(35)])
def test_missing_700_ms_leave_a_run_open(cut: range) -> None:
    """The records of one site are missing at the end, at the beginning or in between."""
    taken = take_apart(make_log_bytes("free", RUN)).without_chain()
    topics = taken.topics()
    accounts = taken.metadata("trilat.accounts")
    topic = "/trilat/free/s/state"
    taken.messages = [
        m for m in taken.messages if topics[m.channel] != topic or m.sequence not in cut
    ]
    accounts[topic] = accounts[topic].replace(
        "received 3000, missing 0", "received 2965, missing 35"
    )
    certificate = certify_bytes(taken.bytes())
    assert certificate.stability is Stability.OPEN
    assert not certificate.passed
    assert any(
        "records are missing: judged s 2965 of 3000 ticks" in why for why in certificate.reasons
    )
    assert not certificate.accepts(("bounded",))
    assert certificate.accepts(("open",))
    # A gap in between leaves a part of V unjudged, so that the theorem is no proof.
    is_in_between = cut.start > 0 and cut.stop < 3000
    tolerant = certify_bytes(taken.bytes(), min_coverage=0.9)
    assert tolerant.evidence.reasons == []
    assert tolerant.passed is not is_in_between


def test_only_recorded_periods_count_for_v() -> None:
    """Single records of one site: few are missing, and each leaves several periods of V unjudged."""
    data = edit_log_bytes(
        make_log_bytes("free", RUN), record=drop_records("s", set(range(100, 3000, 1000)))
    )
    certificate = certify_bytes(data)
    assert certificate.evidence.log.coverage.share == 0.999
    assert certificate.evidence.functional_share is not None
    assert certificate.evidence.functional_share < 0.999
    assert any(why.startswith("V is judged over 99.") for why in certificate.reasons)


def test_no_option_accepts_a_changed_log() -> None:
    pieces = take_apart(make_log_bytes("free", RUN))
    pieces.metadata("trilat.session")["seed"] += "0"
    certificate = certify_bytes(pieces.bytes())
    assert any("changed since it was made" in why for why in certificate.reasons)
    assert not certificate.accepts(("bounded", "open"))


@pytest.mark.parametrize("law", ["adaptive", "adaptive_box"])
def test_torques_foreign_to_the_law_break_the_balance(law: str) -> None:
    def scaled(r: dict) -> dict:
        is_own = r["site"] == "m1" and r["tick"] >= 40
        return {**r, "tau": [x * (1 + 1e-5) for x in r["tau"]]} if is_own else r

    data = make_log_bytes("free", {"duration_s": 2.0, "rate_hz": 100, "control.law": law})
    assert certify_bytes(data).verdict.finding is not StabilityFinding.BROKEN
    for change in (scaled, lambda r: r if r["site"] == "s" else {**r, "tau": [0.0, 0.0]}):
        certificate = certify_bytes(edit_log_bytes(data, record=change))
        assert certificate.verdict.finding is StabilityFinding.BROKEN
        assert "the torque of m1 differs from Eq. (13)" in certificate.verdict.text
        assert not certificate.accepts(("open",))


def test_sites_that_did_not_react_stay_open() -> None:
    claims = {"driver": "rerun", "rerun_executed": "s"}
    certificate = certify_bytes(edit_log_bytes(make_log_bytes("free", RUN), session=claims))
    assert any("m1 and m2 replayed recorded motion" in why for why in certificate.reasons)
    assert certificate.stability is Stability.OPEN
