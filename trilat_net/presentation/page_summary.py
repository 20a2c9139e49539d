"""Renders the top lines of a report: the stability verdict, its checks and key figures.

These lines let a reader decide within seconds whether the run needs a closer look. One of the
key figures is the tracking error e, the difference between the motion of an arm and its
reference.

Invariant:
    - If a number seems to contradict the verdict, a sentence names the number and explains why
      both are true.
    - A failed check is named in the top lines, and its details are expanded.
    - Every string that comes from a log is escaped by the template `summary.html`.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from markupsafe import Markup

from ..analysis import (
    FORCE_NM,
    SETTLED_ERROR_RAD,
    Certificate,
    EndBehaviour,
    JointError,
    LogMetrics,
    Stability,
    Timeline,
)
from ..errors import count_nouns, join_words
from ..log import CheckReport, Log
from ..results import JsonObject
from ..scenario import END_WINDOW_S
from .certificate_text import describe_pace, describe_settling
from .html_templates import render_macro
from .page_html import NO_NUMBER, format_cell, render_details
from .plot_signals import shared_unit
from .style import typeset

_MAX_ALARMS = 8
"""Maximum number of alarms at the top of the page."""
_SEVERE_ALARMS = ("FAULT", "STOPPED")
"""Names of alarms after which a site can no longer move."""

_MEANINGS = {
    Stability.STABLE: "A proof holds for this loop, and the run agrees with it",
    Stability.NOT_STABLE: "The motion of this run does not come to rest",
    Stability.OPEN: "Nothing decides whether this loop is stable",
}
"""Explanation of each verdict. For a settled run it contains values, see `_explain_word`."""
_ROOTS_AND_THEOREM = (
    "This proof is about small motions near the final pose. The paper's theorem, which "
    "is examined below, is another proof, and this one does not need it."
)
"""Explanation for readers if the loop has stable roots although not all premises of the theorem
hold.
"""
_MARKS = {
    Stability.STABLE: "good",
    Stability.SETTLED: "good",
    Stability.NOT_STABLE: "bad",
    Stability.OPEN: "warn",
}
"""Style of each verdict."""
_ENDS = {
    EndBehaviour.DECAYS: "the motion was dying away",
    EndBehaviour.HARDLY: "the motion was hardly dying away",
    EndBehaviour.UNDECIDED: "the motion showed no trend, so a longer record is needed",
    EndBehaviour.COASTS: "an arm coasted, because no operator holds it",
    EndBehaviour.BOUNDED: "the arms oscillated between limits",
    EndBehaviour.DRIFTS: "an arm drifted",
    EndBehaviour.GROWS: "the motion grew",
    EndBehaviour.DIVERGED: "a joint had exceeded its speed limit",
}
"""Clauses, in the past tense, on the motion of the arms at the end of a run.

The clause about a run that converged contains values, see `_explain_end`.
"""


def render_verdict(log: Log, certificate: Certificate, checks: CheckReport) -> Markup:
    """Renders the verdict on whether a run was stable, with the evidence for it.

    The verdict is at the top of the page of a run.

    Args:
        log: Log of the run.
        certificate: Stability certificate of the run.
        checks: Results of the log checks. If any failed, the verdict is in doubt.
    """
    if log.why_empty:
        return render_macro(
            "summary.html",
            "verdict",
            css_class="bad",
            word="Nothing to judge",
            basis=f"{_start_sentence(log.why_empty)}.",
            explanation="",
            remarks="",
        )

    word = certificate.stability.value
    css_class = _MARKS[certificate.stability]
    sentences = [_explain_end(log, certificate)]

    if certificate.stability is Stability.STABLE and certificate.decision.rests_on_roots_alone:
        decay_rate = describe_pace(certificate)
        if decay_rate:
            sentences.append(f"{_start_sentence(decay_rate)}.")
        sentences.append(_ROOTS_AND_THEOREM)

    if checks.failed:
        css_class = "bad" if css_class == "bad" else "warn"
        sentences.append("The log failed a check, so the judgement may be wrong.")

    remarks = [f"{_start_sentence(remark)}." for remark in certificate.remarks]
    return render_macro(
        "summary.html",
        "verdict",
        css_class=css_class,
        word=word.capitalize(),
        basis=typeset(_describe_basis(certificate)),
        explanation=" ".join(sentences),
        remarks=" ".join(remarks),
    )


def _start_sentence(text: str) -> str:
    """Capitalises a clause for use at the start of a sentence.

    Names of arms such as "m1" are case-sensitive and keep their first letter.

    Args:
        text: The clause.
    """
    first_word = text.split(" ", 1)[0]
    is_name = any(letter.isdigit() for letter in first_word) or len(first_word) == 1
    return text if is_name and first_word != "a" else f"{text[:1].upper()}{text[1:]}"


def _describe_basis(certificate: Certificate) -> str:
    """Returns a sentence on the meaning and the basis of a stability verdict.

    How strongly a verdict is supported depends on whether the run was simulated or live, and on
    whether stability was proved or observed.

    Args:
        certificate: Stability certificate of the run.
    """
    decision = certificate.decision
    if certificate.end.behaviour is EndBehaviour.DIVERGED:
        return f"The run {decision.rests_on}."

    meaning = _explain_word(certificate)

    if decision.stability is Stability.STABLE:
        basis = decision.rests_on.replace("; ", ", and ")
        return f"{meaning}: {basis}."
    if decision.stability is not Stability.OPEN:
        return f"{meaning} – {decision.rests_on}."

    # The verdict is open. The first reason is stated, and the others are counted.
    reason, *other_reasons = [text for text in (decision.rests_on, *decision.reasons) if text]
    count_text = (
        f" ({count_nouns(len(other_reasons), 'more reason')} below)" if other_reasons else ""
    )
    return f"{meaning} – {reason}{count_text}."


def _explain_word(certificate: Certificate) -> str:
    """Returns the meaning of the verdict on a run as a clause."""
    if certificate.stability is Stability.SETTLED:
        return _start_sentence(describe_settling(certificate))
    return _MEANINGS[certificate.stability]


def _explain_end(log: Log, certificate: Certificate) -> str:
    """Returns sentences on the end of the motion, and why it does not contradict the verdict.

    The verdict is about the loop: whether disturbances of its motion die away. A stable run may
    still end with remaining errors, for example because an operator keeps pushing. Without an
    explanation, a reader might think that the verdict is wrong.
    """
    end = certificate.end
    if end.missing_sites:
        return f"There is no record of {join_words(end.missing_sites)}."

    stability = certificate.stability
    is_stable = stability in (Stability.STABLE, Stability.SETTLED)
    error_remains = end.end_error_rad > SETTLED_ERROR_RAD
    has_converged = end.behaviour is EndBehaviour.CONVERGED

    # How the motion ends.
    if has_converged:
        speed_text = f"no joint was faster than {end.end_speed_rad_s:.2g} rad/s"
        error_text = f"no error was above {end.end_error_rad:.2g} {end.error_unit}"
        if error_remains:
            error_text = "errors stay"
        clause = f"{speed_text}, and {error_text}"
    elif is_stable and end.behaviour is EndBehaviour.UNDECIDED:
        clause = "the motion alone decided nothing, and the evidence above does not need it"
    else:
        clause = _ENDS[end.behaviour]
    text = f"At the end of the record, {clause}."
    if end.behaviour is EndBehaviour.DIVERGED:
        text = f"The record ends soon after {clause}."

    # Why the end does not contradict the verdict.
    if is_stable and end.stability is Stability.NOT_STABLE:
        return f"{text} The proof and the pushes show that such motion dies away."
    if is_stable and error_remains:
        cause = _explain_remaining_error(log)
        meaning = f"{stability.capitalize()} means that disturbances die away"
        return f"{text} {meaning}, not that errors vanish{cause}."
    if stability is Stability.NOT_STABLE and not error_remains:
        if end.stability is Stability.SETTLED:
            return f"{text} This motion is small, but grows from small disturbances."
        return f"{text} All errors were small then, but they do not die away."
    return text


def _explain_remaining_error(log: Log) -> str:
    """Returns a clause on the sites that operators or walls still push at the end.

    Empty if there are none.
    """
    pushed = _list_pushed_sites(log)
    if not pushed:
        return ""
    return f": hands or walls still push {join_words(pushed)}"


def _list_pushed_sites(log: Log) -> list[str]:
    """Lists the sites that are still pushed by operators or walls in the last record."""
    pushed = []
    for site in log.sites:
        records = log[site]
        if len(records) and np.abs(records.tau_x[-1]).max() > FORCE_NM:
            pushed.append(site)
    return pushed


class _KeyNumber(NamedTuple):
    """One of the most important figures of a run, shown at the top of a report.

    Attributes:
        name: Name of the quantity.
        value: The number with its unit.
        detail: Where and when the number was measured, or what it includes.
    """

    name: str
    value: str
    detail: str


def render_key_numbers(log: Log, facts: JsonObject) -> Markup:
    """Renders the most important figures of a run: its errors, settling time and delays.

    The delays are the ages of the samples that the sites used. The figures are shown below the
    verdict, for readers who read nothing else.

    Args:
        log: Log of the run.
        facts: Key figures of the run, from `summarise_run`.
    """
    numbers = [
        *_list_error_cards(log),
        _describe_settling(log, facts),
        _describe_delay(facts),
    ]
    return render_macro("summary.html", "key_numbers", numbers=numbers)


def _list_error_cards(log: Log) -> list[_KeyNumber]:
    """Returns the key figures about errors, for the slaves and then for the masters.

    The error of a slave shows how well it follows the people. The error of a master is large
    while its operator leads the others, and does not show how well the other arms follow.
    """
    slaves = [site for site in log.sites if log.scenario.sites[site].role == "slave"]
    masters = [site for site in log.sites if site not in slaves]
    cards = []
    if slaves:
        cards.append(_describe_errors(log, slaves, "from its reference"))
        cards += _describe_undelayed_error(log, slaves)
    if masters:
        cards.append(_describe_errors(log, masters, "from the others"))
    return cards


def _describe_errors(log: Log, sites: Sequence[str], place: str) -> _KeyNumber:
    """Returns the largest error of some arms, together with that of the last second.

    The error e is the difference between the actual and the desired angles of an arm.

    Args:
        log: Log of the run.
        sites: Names of the sites.
        place: Phrase for the pose from which the error is measured, appended to the name of the
            number.
    """
    peak = JointError.find_largest_of_all(log, sites)
    if peak is None:
        return _KeyNumber(f"{join_words(sites)} {place}", NO_NUMBER, "no record")

    unit = shared_unit(log)
    detail = f"largest, of {peak.joint}, at {peak.t_s:.2f} s"

    last_errors = [JointError.find_in_last_second(log[site]) for site in sites]
    known_errors = [error for error in last_errors if error is not None]
    last_error = max(known_errors, key=lambda error: error.value, default=None)
    if last_error is not None:
        is_long_enough = log[last_error.site].t_s[-1] >= END_WINDOW_S
        interval_text = "in the last second" if is_long_enough else "in all"
        detail += f"; {last_error.value:.3g} {unit} {interval_text}, of {last_error.joint}"
        if last_error.site in _list_pushed_sites(log):
            detail += ", which a hand or a wall still pushes"
    return _KeyNumber(f"{join_words(sites)} {place}", f"{peak.value:.3g} {unit}", detail)


def _describe_undelayed_error(log: Log, slaves: Sequence[str]) -> list[_KeyNumber]:
    """Returns how far the slave arms were from the other arms at the same time.

    The tracking error compares a slave with states that the other arms sent some time ago. A
    reader who sees the arms apart on the screen is interested in the distance at the same time.

    Args:
        log: Log of the run.
        slaves: Names of the slaves.

    Returns:
        A list with the number. Empty if the distance is unknown.
    """
    distances = LogMetrics.find_undelayed_maxima(log, slaves)
    if not distances:
        return []

    unit = "rad" if shared_unit(log) == "rad" else "m"
    name = f"{join_words(slaves)} from where the masters are"
    value = f"{max(distances.values()):.3g} {unit}"
    return [_KeyNumber(name, value, "largest at the same moment, delay included")]


def _describe_settling(log: Log, facts: JsonObject) -> _KeyNumber:
    """Returns the time from which all errors stay below the settling limit."""
    name = f"All errors below {facts['settle_below_rad']:g} {shared_unit(log)}"
    if facts["max_error_end_rad"] is None:
        return _KeyNumber(name, NO_NUMBER, "no record")
    if facts["settle_s"] is None:
        return _KeyNumber(name, "not at the end", "a measure of following, not of stability")
    if facts["settle_s"] == 0.0:
        return _KeyNumber(name, "always", "of every site and joint")
    return _KeyNumber(name, f"from {facts['settle_s']:.2f} s on", "of every site and joint")


def _describe_delay(facts: JsonObject) -> _KeyNumber:
    """Returns the mean and the range of the ages of the samples that were used.

    The age of another arm's sample is the delay that a controller experiences.
    """
    ages_ms = [link["age_ms"] for link in facts["links"].values()]
    means_ms = [age["mean"] for age in ages_ms if age["mean"] is not None]
    if not means_ms:
        return _KeyNumber("Delay in use", NO_NUMBER, "no sample was used")

    mean_ms = f"{float(np.mean(means_ms)):.3g}"
    youngest_ms = format_cell(min(age["min"] for age in ages_ms if age["min"] is not None))
    oldest_ms = format_cell(max(age["max"] for age in ages_ms if age["max"] is not None))
    links_text = count_nouns(len(means_ms), "link")

    detail = f"mean of {links_text}; {youngest_ms} to {oldest_ms} ms"
    if youngest_ms == oldest_ms:
        detail = f"on {links_text}, always"
    return _KeyNumber("Delay in use", f"{mean_ms} ms", detail)


def render_alarms(log: Log) -> Markup:
    """Renders the alarms of a run, such as an emergency stop, as a list in large print.

    If there are severe alarms (faults and stops), only these are listed, because other alarms
    usually follow from them. The list shows at most `_MAX_ALARMS` alarms and the number of
    remaining ones.

    Args:
        log: Log of the run.

    Returns:
        HTML of the list. Empty if there were no alarms.
    """
    alarms = Timeline(log).alarms
    if not alarms:
        return Markup()

    severe_alarms = [alarm for alarm in alarms if alarm.word in _SEVERE_ALARMS]
    candidates = severe_alarms if severe_alarms else alarms
    listed_alarms = candidates[:_MAX_ALARMS]

    return render_macro(
        "summary.html",
        "alarms",
        alarms=listed_alarms,
        severe_words=_SEVERE_ALARMS,
        not_listed=len(alarms) - len(listed_alarms),
    )


def render_checks(checks: CheckReport, facts: JsonObject) -> Markup:
    """Renders the results of the log checks as one line, which expands into a list.

    The list is expanded initially if a check has failed.

    Args:
        checks: Results of the checks. Some may be undecided, for example because the code of a
            user's control law is not allowed to run here.
        facts: Key figures of the run, from `summarise_run`.

    Returns:
        HTML of the line. Empty if nothing was checked.
    """
    if not checks.findings:
        return Markup()

    undecided_checks = [finding.check for finding in checks.findings if not finding.judged]
    summary = f"✓ {_summarise_checks(checks, facts)}"
    if checks.failed:
        summary = f"✗ Failed: {', '.join(checks.failed)}"
    elif undecided_checks:
        summary = f"? Not judged: {', '.join(undecided_checks)}"

    result_list = render_macro("summary.html", "checks", findings=checks.findings)
    details = render_details(summary, result_list, is_open=bool(checks.failed))
    return render_macro("summary.html", "check_line", details=details)


def _summarise_checks(checks: CheckReport, facts: JsonObject) -> str:
    """Returns a sentence about the log checks if all of them passed.

    For example: "All records present; executed again bit for bit; 3 other checks passed." A
    result with a remark, such as ticks that a site did not execute, is quoted in full.
    """
    clauses = []
    for finding in checks.findings:
        has_remark = ";" in finding.text
        if finding.check == "records":
            missing = facts["missing"]
            complete_text = "all records present"
            missing_text = f"{count_nouns(missing, 'record')} missing"
            clauses.append(missing_text if missing else complete_text)
        elif finding.check == "executed again" and not has_remark:
            is_exact = "bit for bit" in finding.text
            agreement = "bit for bit" if is_exact else "to 1e-9"
            clauses.append(f"executed again {agreement}")
        elif finding.check == "executed again":
            clauses.append(f"executed again: {finding.text}")

    other_count = len(checks.findings) - len(clauses)
    if other_count:
        clauses.append(f"{count_nouns(other_count, 'other check')} passed")
    text = "; ".join(clauses)
    return f"{text[:1].upper()}{text[1:]}."
