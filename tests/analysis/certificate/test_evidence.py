"""What a certificate rests on: records that are missing, changed, or no site's own."""

import pytest

from tests.log_editing import edited, opened, recorded, without
from tests.log_surgery import taken_apart
from trilat_net.analysis.certificate.stability_certificate import (
    Certificate,
    StabilityFinding,
    certificate_to_json,
    certify,
)
from trilat_net.analysis.run_end import Stability

RUN = {"duration_s": 60.0, "rate_hz": 50, "link.delay_ms": 200.0}


def found(data: bytes, **options: float) -> Certificate:
    return certify(opened(data), **options)


def test_whole_log_is_stable_and_says_what_it_rests_on() -> None:
    certificate = found(recorded("free", RUN))
    assert certificate.stability is Stability.STABLE
    facts = certificate_to_json(certificate)["evidence"]
    assert facts == {
        "coverage": 1.0,
        "functional_coverage": 1.0,
        "min_coverage": 0.999,
        "judged": {site: [3000, 3000] for site in ("m1", "m2", "s")},
        "integrity": "intact",
        "open_loop_sites": [],
    }


@pytest.mark.parametrize("cut", [range(1490, 1525), range(2965, 3000), range(35)])
def test_seven_tenths_of_a_second_less_leave_a_run_open(cut: range) -> None:
    """At its end, its beginning or in between, of one site."""
    taken = taken_apart(recorded("free", RUN)).without_chain()
    topics, accounts = taken.topics(), taken.metadata("trilat.accounts")
    own = "/trilat/free/s/state"
    taken.messages = [m for m in taken.messages if topics[m.channel] != own or m.sequence not in cut]
    accounts[own] = accounts[own].replace("received 3000, missing 0", "received 2965, missing 35")
    certificate = found(taken.bytes())
    assert certificate.stability is Stability.OPEN
    assert not certificate.passed
    assert any("records are missing: judged s 2965 of 3000 ticks" in why for why in certificate.reasons)
    assert not certificate.accepts(("bounded",))
    assert certificate.accepts(("open",))
    assert found(taken.bytes(), min_coverage=0.9).passed


def test_of_v_the_periods_count_that_rest_on_records() -> None:
    """Single records of one site: few are missing, and each leaves several periods of V unjudged."""
    data = edited(recorded("free", RUN), record=without("s", set(range(100, 3000, 1000))))
    certificate = found(data)
    assert certificate.evidence.coverage.share == 0.999
    assert certificate.evidence.functional_share is not None
    assert certificate.evidence.functional_share < 0.999
    assert any(why.startswith("V is judged over 99.") for why in certificate.reasons)


def test_a_changed_log_is_accepted_by_no_word() -> None:
    taken = taken_apart(recorded("free", RUN))
    taken.metadata("trilat.session")["seed"] += "0"
    certificate = found(taken.bytes())
    assert any("changed since it was made" in why for why in certificate.reasons)
    assert not certificate.accepts(("bounded", "open"))


@pytest.mark.parametrize("law", ["adaptive", "adaptive_box"])
def test_torques_that_the_law_did_not_give_break_the_balance(law: str) -> None:
    def scaled(r: dict) -> dict:
        own = r["site"] == "m1" and r["tick"] >= 40
        return {**r, "tau": [x * (1 + 1e-5) for x in r["tau"]]} if own else r

    data = recorded("free", {"duration_s": 2.0, "rate_hz": 100, "control.law": law})
    assert found(data).verdict.finding is not StabilityFinding.BROKEN
    for change in (scaled, lambda r: r if r["site"] == "s" else {**r, "tau": [0.0, 0.0]}):
        certificate = found(edited(data, record=change))
        assert certificate.verdict.finding is StabilityFinding.BROKEN
        assert "the torque of m1 is not that of Eq. (13)" in certificate.verdict.text
        assert not certificate.accepts(("open",))


def test_sites_that_did_not_react_leave_a_run_open() -> None:
    claims = {"driver": "rerun", "rerun_executed": "s"}
    certificate = found(edited(recorded("free", RUN), session=claims))
    assert any("m1 and m2, as recorded, did not react" in why for why in certificate.reasons)
    assert certificate.stability is Stability.OPEN
