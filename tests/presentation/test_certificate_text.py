"""The text of a certificate in the report, on a terminal and in JSON."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from tests.analysis.builders import (
    JITTER,
    LYAPUNOV,
    make_busy_run,
    make_diverged_log,
    make_run,
    make_short_log,
)
from tests.log.builders import rewrite_log
from trilat_net.analysis.certificate.stability_certificate import Certificate
from trilat_net.analysis.judge import certify_run
from trilat_net.analysis.run_end import EndBehaviour, Stability
from trilat_net.analysis.stability_decision import LoopRoots
from trilat_net.analysis.twins.envelope_trend import EnvelopeTrend
from trilat_net.analysis.twins.twin_growth import PushGrowth, TwinGrowth
from trilat_net.analysis.twins.twin_runs import Push
from trilat_net.log.findings import CheckReport
from trilat_net.presentation.certificate_text import (
    describe_certificate,
    describe_in_words,
    describe_judgement,
    describe_pace,
    list_energies,
)
from trilat_net.presentation.figures.certificate_energy import draw_functional
from trilat_net.presentation.page_summary import render_verdict
from trilat_net.scenario import load_scenario

LOGS = {
    "free": lambda: make_run("free", {"duration_s": 4.0, "rate_hz": 200}).log,
    "jitter": lambda: make_run("free", {**JITTER, "rate_hz": 100}).log,
    "rich": lambda: make_run("rich").log,
    "four": lambda: make_short_log("four"),
    "p_d": lambda: (
        make_run("free", {"control.law": "p_d", "duration_s": 1.0, "rate_hz": 200}).log
    ),
    "empty": lambda: rewrite_log(make_short_log("paper"), lambda _: False),
    "diverged": make_diverged_log,
    "busy": lambda: make_busy_run().log,
}


@pytest.mark.parametrize("name", LOGS)
def test_facts_are_json_without_nan(name: str) -> None:
    certificate = Certificate.of_log(LOGS[name]())
    read = json.loads(json.dumps(certificate.to_dict(), allow_nan=False))
    assert read["text"] == certificate.verdict.text
    assert read["passed"] is certificate.passed
    assert (read["functional"] is None) == (certificate.balance is None)
    assert (read["rise"] is None) == (certificate.verdict.rise is None)
    assert all(set(premise) == {"name", "holds", "text"} for premise in read["premises"])


def test_the_numbers_add_up() -> None:
    """V at the end is V at the start, less the dissipation, plus the work, to the residual."""
    f = Certificate.of_log(LOGS["jitter"]()).to_dict()["functional"]
    end = f["v_first_j"] - sum(f["taken_j"].values()) + sum(f["given_j"].values())
    assert end == pytest.approx(f["v_last_j"], abs=f["residual_max_j"])
    assert sum(f["parts_last_j"].values()) == pytest.approx(f["v_last_j"])


@pytest.mark.parametrize("name", LOGS)
def test_figures_are_a_function_of_the_log(name: str) -> None:
    log = LOGS[name]()
    certificate = Certificate.of_log(log)
    figure = draw_functional(log, certificate)
    if certificate.balance is None:
        assert [text.get_text() for text in figure.texts] == [certificate.verdict.text]
        return
    assert [axes.get_ylabel()[-3:] for axes in figure.axes] == ["(J)"] * 4
    assert figure.axes[-1].get_xlabel() == "time (s)"
    assert figure.axes[-1].get_yscale() == "log"
    total = figure.axes[0].lines[0]
    assert np.max(total.get_ydata()) == pytest.approx(certificate.balance.V.max())
    marked = [p for p in figure.axes[0].patches if p.get_zorder() == 0.4]
    assert len(marked) == (certificate.verdict.rise is not None)


@pytest.mark.parametrize(
    ("name", "marks"),
    [
        ("free", "open ok open ok ok"),
        ("jitter", "open open open ok ok"),
        ("rich", "open open open ok ok note"),
        ("p_d", "open open ok"),
        ("diverged", "FAIL ok ok ok"),
    ],
)
def test_lines_give_judgement_verdict_end_and_balance(name: str, marks: str) -> None:
    certificate = Certificate.of_log(LOGS[name]())
    text = describe_certificate(certificate)
    assert [line.mark for line in text] == marks.split()
    assert text[0].text.startswith(f"{certificate.stability}: {certificate.end.behaviour}")
    of_v = [] if name == "p_d" else [certificate.verdict.text]  # the law P+d has no V
    texts = [line.text for line in text]
    of_end = [] if name == "diverged" else [f"e and qd: {certificate.end.text}"]
    assert texts[1 : 1 + len(of_v + of_end)] == of_v + of_end


@pytest.mark.parametrize("behaviour", EndBehaviour)
@pytest.mark.parametrize("name", LOGS)
@pytest.mark.parametrize("root_per_s", [-0.25, 0.25])
def test_the_first_line_agrees_with_its_judgement(
    name: str, behaviour: EndBehaviour, root_per_s: float
) -> None:
    certificate = Certificate.of_log(LOGS[name]())
    word = "stable" if root_per_s < 0.0 else "unstable"
    roots = LoopRoots(word, root_per_s, True)
    judged = replace(
        certificate, end=certificate.end._replace(behaviour=behaviour), roots=roots
    )
    lines = describe_certificate(judged)
    (first,) = lines[0].print_form.lines()
    assert not re.search(r"\b(\w+)\W+\1\b", first)
    if judged.stability is Stability.STABLE:
        assert "undecided" not in first
        assert "too short" not in first
    # A judgement against stability rests on a line that is marked so.
    if judged.stability is Stability.NOT_STABLE and behaviour is not EndBehaviour.DIVERGED:
        assert "FAIL" in [line.mark for line in lines[1:]]


PUSH = PushGrowth(
    push=Push.choose(load_scenario("two_sites"))[0],
    trend=EnvelopeTrend.DECAYS,
    rate_per_s=-0.5,
    factor=0.01,
    joint="m1 joint 1",
    group=0,
    becomes_rad_s=1e-7,
)
EVIDENCE = {
    "proof": ("stable", (PUSH,)),
    "pushes": ("", (PUSH,)),
    "growing push": (
        "",
        (PUSH._replace(trend=EnvelopeTrend.GROWS, rate_per_s=0.5, factor=9.0),),
    ),
    "growing root": ("unstable", ()),
    "nothing": ("", ()),
}
"""Verdict of exact roots, and pushes, by what they show."""


def judge_end(behaviour: EndBehaviour, evidence: str, speed_rad_s: float) -> Certificate:
    """Returns the certificate of a run with the given end and evidence, and without doubts."""
    certificate = Certificate.of_log(LOGS["p_d"]())
    verdict, pushes = EVIDENCE[evidence]
    end = certificate.end._replace(
        behaviour=behaviour, doubts=(), operator_acts=False, end_speed_rad_s=speed_rad_s
    )
    roots = LoopRoots(verdict, None, bool(verdict))
    return replace(certificate, end=end, roots=roots, twins=TwinGrowth("", 10.0, 20.0, pushes))


@pytest.mark.parametrize("behaviour", EndBehaviour)
@pytest.mark.parametrize("evidence", EVIDENCE)
@pytest.mark.parametrize("speed_rad_s", [1e-4, 1.0])
def test_halves_of_a_headline_agree(
    behaviour: EndBehaviour, evidence: str, speed_rad_s: float
) -> None:
    """A word that the end of the record alone would not get says what it rests on instead."""
    certificate = judge_end(behaviour, evidence, speed_rad_s)
    word = certificate.stability.value
    headline = certificate.headline()
    assert headline.startswith(word)
    if behaviour.stability is certificate.stability or word == "open":
        assert headline.startswith(f"{word}: ")
    elif behaviour.stability is Stability.SETTLED and word == "stable":
        assert headline.startswith("stable: ")
    elif word == "settled":
        assert "too slow to move by 0.01 rad" in headline
    else:
        assert headline.startswith(("stable by proof, although ", "not stable, although "))
    if word in ("stable", "settled"):
        assert not re.search("no trend|growing|undecided|oscillation|drifting", headline)


@pytest.mark.parametrize("behaviour", [EndBehaviour.CONVERGED, EndBehaviour.DECAYS])
def test_settled_runs_state_their_speed(behaviour: EndBehaviour) -> None:
    """Nothing claims that arms came to rest which are only slow, or slow down."""
    certificate = judge_end(behaviour, "pushes", 0.0043)
    assert certificate.stability is Stability.SETTLED
    text = " ".join(line.text for line in describe_in_words(certificate))
    assert "no joint was faster than 0.0043 rad/s at the end" in text
    verdict = render_verdict(make_short_log("paper"), certificate, CheckReport([]))
    assert "no joint was faster than 0.0043 rad/s" in verdict
    assert "came to rest" not in f"{certificate.headline()} {text} {verdict}"


def test_divergence_is_stated_once_with_its_joint() -> None:
    log = make_diverged_log()
    certificate = Certificate.of_log(log)
    cause = log.describe_divergence()
    assert re.fullmatch(
        r"(m1|m2|s) joint [12] reached 0\.\d+ rad/s \(limit 0\.5 rad/s\) at \S+ s", cause
    )
    texts = [line.text for line in describe_certificate(certificate)]
    assert texts[0] == f"not stable: diverged: {cause}"
    assert not [text for text in texts[1:] if "diverged at" in text or cause in text]
    site = cause.split()[0]
    speed_rad_s = float(cause.split("reached ")[1].split()[0])
    assert np.abs(log[site].qd[-1]).max() == pytest.approx(speed_rad_s, rel=1e-2)


def test_sentences_about_a_record_fit_its_length() -> None:
    """This run diverged after milliseconds, so that there is neither a last second nor a push to follow."""
    short = {"duration_s": 2.0, "rate_hz": 1000, "limits.qd_limit_rad_s": 0.02}
    log = make_run("free", short).log
    certificate = certify_run(log)
    assert certificate.twins is not None
    assert certificate.twins.text == "twins: too short a record to follow a push"
    texts = [line.text for line in describe_certificate(certificate)]
    assert not [text for text in texts if "last second" in text]
    brief = make_run("free", {"duration_s": 0.5, "rate_hz": 200}).certificate
    assert brief.end.text.endswith("in the whole record")
    assert make_run("free", {"duration_s": 1.5, "rate_hz": 200}).certificate.end.text.endswith(
        "in the last second"
    )


def test_short_runs_state_their_length_once() -> None:
    slow = LoopRoots("stable", -0.25, True)
    certificate = make_run("free", {"duration_s": 4.0, "rate_hz": 200}).certificate
    end = certificate.end._replace(behaviour=EndBehaviour.UNDECIDED, doubts=())
    short = replace(certificate, end=end, roots=slow)
    needed_s = 8.0 * np.log(2.0) / 0.25 + end.quiet_from_s
    assert describe_judgement(short) == (
        f"open: the run is too short to tell; a run of {needed_s:.3g} s would be long enough"
    )
    long = replace(short, end=end._replace(lasts_s=needed_s))
    assert "too short" not in describe_judgement(long)
    assert end.text not in describe_judgement(long)  # the line of the end has it


def test_pace_follows_the_slowest_root() -> None:
    certificate = make_run("free", {"duration_s": 4.0, "rate_hz": 200}).certificate
    for rate_per_s, verb in ((-0.5, "halves"), (0.5, "doubles")):
        verdict = "stable" if rate_per_s < 0.0 else "unstable"
        roots = LoopRoots(verdict, rate_per_s, True)
        judged = replace(certificate, roots=roots)
        assert describe_pace(judged) == f"a small disturbance {verb} every 1.4 s"
        assert describe_pace(replace(judged, roots=roots._replace(exact=False))) == ""


def test_many_links_are_one_entry() -> None:
    balance = Certificate.of_log(LOGS["four"]()).balance
    assert balance is not None
    some = {f"a->{n}": np.ones_like(balance.V) for n in range(7)}
    names = [name for name, _ in list_energies(replace(balance, work={**balance.work, **some}))]
    assert [name for name in names if "->" in name or "links" in name] == ["supplied: 19 links"]


def test_wrong_weights_of_the_paper_are_named() -> None:
    last_line = describe_certificate(make_run("free", LYAPUNOV).certificate)[-1]
    assert last_line.mark == "note"
    assert last_line.text.startswith(
        "with the paper's weights, ones, V would have risen by 12.3 J of 32.8"
    )
    assert (
        make_run("free", {"duration_s": 4.0, "rate_hz": 200}).certificate.paper_balance is None
    )


@pytest.mark.parametrize("name", ["jitter", "rich", "busy"])
def test_listed_energies_sum_to_v(name: str) -> None:
    certificate = Certificate.of_log(LOGS[name]())
    assert certificate.balance is not None
    (_, first), *between, (_, last) = list_energies(certificate.balance)
    assert first + sum(amount for _, amount in between) == pytest.approx(
        last, abs=1e-5 * certificate.balance.scale
    )


def test_missing_energies_are_reported() -> None:
    rest = {"control.theta_hat0": [3.0, 1.0, 1.0, 2.0, 1.0], "duration_s": 0.5, "rate_hz": 200}
    certificate = Certificate.of_log(make_run("paper", rest).log)
    assert "energy balance: there is no energy in this run" in [
        line.text for line in describe_certificate(certificate)
    ]
