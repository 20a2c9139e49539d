"""The first lines of a report: a judgement that agrees with every number beside it."""

import re
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from html import unescape
from pathlib import Path

import numpy as np
import pytest

from tests.analysis.builders import make_run, make_short_log
from tests.log.builders import (
    edit_log_bytes,
    make_log_bytes,
    replace_fields,
    rewrite_log,
    write_log,
)
from trilat_net.analysis.certificate.stability_certificate import Certificate
from trilat_net.analysis.file_overview import summarise_run
from trilat_net.analysis.judge import certify_run
from trilat_net.analysis.metrics.log_metrics import LogMetrics
from trilat_net.analysis.run_end import EndBehaviour, Stability
from trilat_net.analysis.site_signals import SETTLED_ERROR_RAD, JointError
from trilat_net.analysis.stability_decision import LoopRoots
from trilat_net.log.findings import CheckReport, Finding
from trilat_net.log.log_reader import Log, open_log
from trilat_net.presentation.certificate_text import describe_certificate
from trilat_net.presentation.conclusion import _tabulate_sites, conclude
from trilat_net.presentation.page_summary import (
    render_checks,
    render_key_numbers,
    render_verdict,
)
from trilat_net.presentation.result_text import compose
from trilat_net.presentation.style import typeset

STABLE_ROOTS = LoopRoots("stable", -0.5, True)
PASSED = Finding("records", "8/8 in the file; judged all 8 ticks")
EXACT = Finding("executed again", "8/8 records identical (whole runs, bit for bit)")
WRONG = Finding("executed again", "7/8 records identical; 1 differs", passed=False)


@cache
def make_paper_log() -> Log:
    return make_run("paper", {"duration_s": 2.0, "rate_hz": 100}).log


def make_certificate(
    behaviour: EndBehaviour, error_rad: float, **fields: object
) -> Certificate:
    """Returns a certificate of a run with a proof, with the given behaviour and error at its end."""
    certificate = make_run("paper", {"duration_s": 2.0, "rate_hz": 100}).certificate
    end = certificate.end._replace(
        behaviour=behaviour, end_error_rad=error_rad, doubts=(), operator_acts=False
    )
    return replace(certificate, **{"end": end, "roots": STABLE_ROOTS, **fields})


def verdict_text(certificate: Certificate, findings: Sequence[Finding] = ()) -> str:
    return render_verdict(make_paper_log(), certificate, CheckReport(list(findings)))


def test_stable_run_names_its_proof() -> None:
    certificate = make_certificate(EndBehaviour.CONVERGED, 0.0012)
    assert certificate.stability is Stability.STABLE
    speed_rad_s = certificate.end.end_speed_rad_s
    html = verdict_text(certificate)
    assert '<strong class="chip good">Stable</strong> A proof holds for this loop' in html
    assert "exact roots, slowest -0.5 /s." in html
    assert "small motions near the final pose" in html
    assert f"was faster than {speed_rad_s:.2g} rad/s, and no error was above 0.0012 rad" in html


def test_lasting_errors_are_explained() -> None:
    certificate = make_certificate(EndBehaviour.CONVERGED, 2 * SETTLED_ERROR_RAD)
    assert certificate.headline().startswith("stable: at rest, with remaining errors; ")
    html = verdict_text(certificate)
    speed_rad_s = certificate.end.end_speed_rad_s
    assert f"no joint was faster than {speed_rad_s:.2g} rad/s, and errors stay" in html
    assert "agreed" not in html
    assert "Stable means that disturbances die away, not that errors vanish" in html


def test_pushing_hands_are_named() -> None:
    log = make_short_log("paper")
    pushed = rewrite_log(log, change=lambda row: replace_fields(row, tau_x=[1.0, 0.0]))
    html = render_verdict(
        pushed, make_certificate(EndBehaviour.CONVERGED, 0.4), CheckReport([])
    )
    assert "not that errors vanish: hands or walls still push m1, m2 and s." in html


def test_calm_end_of_unstable_loop_is_explained() -> None:
    growing = LoopRoots("unstable", 0.1, True)
    html = verdict_text(make_certificate(EndBehaviour.CONVERGED, 0.0, roots=growing))
    assert "Not stable" in html
    assert "This motion is small, but grows from small disturbances." in html


def test_small_oscillation_is_not_called_settled() -> None:
    html = verdict_text(make_certificate(EndBehaviour.BOUNDED, 0.001, roots=None))
    assert "Not stable" in html
    assert "All errors were small then, but they do not die away." in html


def test_an_open_run_names_its_first_reason() -> None:
    certificate = make_certificate(EndBehaviour.HARDLY, 0.2, roots=None)
    assert certificate.stability is Stability.OPEN
    text = unescape(verdict_text(certificate))
    assert typeset(certificate.reasons[0]) in text
    assert ("more reason" in text) == (len(certificate.reasons) > 1)


def test_failed_check_puts_judgement_in_doubt() -> None:
    certificate = make_certificate(EndBehaviour.CONVERGED, 0.0)
    assert "failed a check" not in verdict_text(certificate, [PASSED, EXACT])
    html = verdict_text(certificate, [PASSED, WRONG])
    assert "The log failed a check" in html
    assert 'class="chip warn"' in html


def test_checks_that_passed_are_one_line() -> None:
    facts = {"missing": 0}
    html = render_checks(CheckReport([PASSED, EXACT, Finding("integrity")]), facts)
    summary = "✓ All records present; executed again bit for bit; 1 other check passed."
    assert f"<details><summary>{summary}</summary>" in html
    assert "8/8 in the file" in html
    assert "3 records missing" in render_checks(CheckReport([PASSED]), {"missing": 3})
    assert render_checks(CheckReport([]), facts) == ""


@pytest.mark.parametrize(
    ("finding", "phrase"),
    [
        (WRONG, "<details open><summary>✗ Failed: executed again</summary>"),
        (
            Finding("user law", "not allowed", passed=False, judged=False),
            "<details><summary>? Not judged: user law</summary>",
        ),
    ],
)
def test_a_failed_check_is_named(finding: Finding, phrase: str) -> None:
    assert phrase in render_checks(CheckReport([PASSED, finding]), {"missing": 0})


def test_key_numbers_have_place_and_time() -> None:
    log = make_short_log("paper")
    facts = summarise_run(log)
    html = render_key_numbers(log, facts)
    names = {"s from its reference": ["s"], "m1 and m2 from the others": ["m1", "m2"]}
    for name, sites in names.items():
        peak = JointError.find_largest_of_all(log, sites)
        assert peak is not None
        assert peak.value == max(facts["sites"][site]["max_error_rad"] for site in sites)
        joint = int(peak.joint.removeprefix(f"{peak.site} joint ")) - 1
        row = int(np.searchsorted(log[peak.site].t_s, peak.t_s))
        assert abs(log[peak.site].e[row, joint]) == peak.value
        last = max(facts["sites"][site]["max_error_end_rad"] for site in sites)
        assert f"<dt>{name}" in html
        assert f"joint {joint + 1}, at {peak.t_s:.2f} s; {last:.3g} rad in the last" in html
    undelayed_rad = LogMetrics.find_undelayed_maxima(log, ["s"])["s"]
    tile = f"<dt>s from where the masters are</dt><dd>{undelayed_rad:.3g} rad</dd>"
    assert tile in html
    # the remote arm is first
    assert html.index("<dt>s from") < html.index("<dt>m1 and m2 from")
    assert "<dd>200 ms</dd>" in html
    assert "a measure of following, not of stability" in html


@pytest.mark.parametrize("name", ["paper", "four"])
def test_all_texts_have_the_same_last_error(name: str) -> None:
    """The page, the table of `report` and `certify` name one number and its joint."""
    log = make_short_log(name)
    certificate = Certificate.of_log(log)
    error = JointError.find_last_of_all(log)
    assert error is not None
    facts = summarise_run(log)
    assert facts["max_error_end_rad"] == certificate.end.end_error_rad == error.value
    assert f"{error.value:.3g} rad in the last second, of {error.joint}" in render_key_numbers(
        log, facts
    )
    assert f"largest |e| {error.value:.3g} rad of {error.joint} and" in certificate.end.text
    table = _tabulate_sites(log, is_timed=False)
    row = next(row for row in table.rows if row[0] == error.site)
    assert list(row[-2:]) == [f"{error.value:.3g}", error.joint.removeprefix(f"{error.site} ")]


def test_limits_stand_under_the_judgement() -> None:
    log = make_short_log("paper")
    limit_nm = log.scenario.sites["m1"].limits.tau_limit_nm
    at_limit = rewrite_log(
        log,
        change=lambda row: (
            replace_fields(row, tau=[-limit_nm, 0.0])
            if row.site == "m1" and row.tick < 30
            else row
        ),
    )
    remark = "m1 was at its torque limit for 0.15 s"
    assert remark not in certify_run(log, twins=0).remarks
    certificate = certify_run(at_limit, twins=0)
    assert certificate.remarks == (remark,)
    assert f'<p class="remarks">{remark}.</p>' in render_verdict(
        at_limit, certificate, CheckReport([])
    )
    for brief in (True, False):
        texts = [block.lines()[0] for block in compose(certificate, brief=brief)]
        line_index = texts.index(f"note {remark}")
        reasons = [line.text for line in describe_certificate(certificate)]
        assert line_index in (1, 2)  # before the reasons
        assert texts[line_index + 1].endswith(reasons[1])


def test_log_without_records_has_dashes() -> None:
    empty = rewrite_log(make_short_log("paper"), lambda _: False, finished=False)
    html = render_key_numbers(empty, summarise_run(empty))
    assert html.count("<dd>–</dd>") == 4


def test_sessions_without_records_get_no_judgement(tmp_path: Path) -> None:
    """A session that ended before any site published anything is neither stable nor open."""
    path = write_log(
        tmp_path, edit_log_bytes(make_log_bytes("two_sites"), record=lambda _: None)
    )
    conclusion = conclude(open_log(path), tmp_path)
    assert conclusion.verdict.text == "nothing to judge: no site has a record in this log"
    assert conclusion.exit_code == 1
    chips = re.findall('<strong class="chip bad">(.*?)</strong>', conclusion.page.read_text())
    assert chips == ["Nothing to judge"]


def test_end_errors_of_pushed_arms_are_marked() -> None:
    log = make_short_log("paper")
    text = "which a hand or a wall still pushes"
    for torque_nm, is_pushed in ((1.0, True), (0.0, False)):
        run = rewrite_log(
            log,
            change=lambda row, t=torque_nm: replace_fields(row, tau_x=[t, 0.0]),  # type: ignore[misc]
        )
        assert (text in render_key_numbers(run, summarise_run(run))) == is_pushed
