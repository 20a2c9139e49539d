"""Composes the short output of `trilat certify` and `trilat metrics`, about ten lines each.

The short output lets a reader see within seconds whether a run was stable and how well the arms
followed each other. With the option --all, the commands print everything; see
`certificate_text` and `metrics_text`.

Invariant:
    - A short text has at most `MOST_LINES` lines, plus one line that mentions --all. The
      explanation of a verdict and remarks about the run are not counted.
    - Each line is also printed with --all, or contains the largest of the values printed with
      --all.
    - The verdict comes first, and a line that contradicts stability is never omitted.
"""

from collections.abc import Iterator

from ..analysis import Certificate, LogMetrics, Metric, Quantity
from ..errors import count_nouns
from .certificate_text import (
    CertificateLine,
    describe_certificate,
    describe_in_words,
    select_premises,
)
from .result_text import Block, TextTable
from .untrusted_text import sanitize

MOST_LINES = 10
"""Maximum number of lines of a short text."""
_KEY_METRICS = (
    "max_error_rad",
    "max_error_m",
    "max_error_end_rad",
    "max_error_end_m",
    "settle_s",
    "following_rms_rad",
    "following_rms_m",
    "peak_tau_nm",
    "force_peak_n",
    "sharing_off",
    "takeover_s",
    "age_mean_ms",
    "age_max_ms",
    "loss",
    "late_max_us",
    "missing",
    "rms_error_rad",
    "chatter_nm",
    "hands_j",
    "effort_nm2_s",
)
"""Metric keys in descending order of importance. The first ten available for a run are printed.
"""
_PREMISES = "premises are what the theorem requires (docs/reference/certificate-premises.md)"
"""Explanation of the word "premise" in the output of `trilat certify`."""
_MARK_RANKS = {"FAIL": 0, "open": 1, "ok": 2, "note": 3}
"""Rank of a certificate line by its mark; lower ranks are more important."""


def compose_key_reasons(certificate: Certificate) -> Iterator[Block]:
    """Yields the stability verdict on a run and the most important reasons for it.

    `trilat certify` prints these lines by default, and all reasons with the option --all.

    Args:
        certificate: Stability certificate of the run.
    """
    lines = describe_certificate(certificate)
    judgement, *reasons = _choose_lines(lines)
    explanations = describe_in_words(certificate)
    for line in (judgement, *explanations, *reasons):
        yield line.print_form

    # A last line tells the user what this short text leaves out.
    premise_count = len(select_premises(certificate))
    counts = {"more line": max(0, len(lines) - MOST_LINES), "premise": premise_count}
    omitted = [count_nouns(count, noun) for noun, count in counts.items() if count]
    if certificate.balance is not None:
        omitted.append("the energies")
    if omitted:
        hint = f"--all prints {' and '.join(omitted)} too"
        yield f"{hint}; {_PREMISES}" if premise_count else hint


def _choose_lines(lines: list[CertificateLine]) -> list[CertificateLine]:
    """Selects the most important lines of a stability certificate, in their original order.

    Lines that contradict stability take precedence over lines that confirm it.

    Args:
        lines: All lines of the certificate, starting with the verdict.
    """
    ranks = [_MARK_RANKS[line.mark] for line in lines]
    ranks[0] = -1
    by_importance = sorted(range(len(lines)), key=lambda index: (ranks[index], index))
    chosen = sorted(by_importance[:MOST_LINES])
    return [lines[index] for index in chosen]


def compose_key_metrics(metrics: LogMetrics) -> Iterator[Block]:
    """Yields a table of the ten most important metrics of a run, each with its subject.

    The subject states to what the value applies, for example the site with the largest value,
    or "every site" if the value is the same at all sites.

    Args:
        metrics: All metrics of the run.
    """
    by_key = {quantity.key: quantity for quantity in Quantity.list_all()}
    rows = []
    for key in _KEY_METRICS:
        row = _make_row(metrics, by_key[key])
        if row:
            rows.append(row)
    headers = (metrics.scenario, "largest", "", "of")
    yield TextTable(headers, rows[:MOST_LINES], align="lrll")
    yield "--all prints every number, by site, link and wall"


def _make_row(metrics: LogMetrics, quantity: Quantity) -> list[str]:
    """Returns the row of a quantity in the short table of a run's most important metrics.

    The row contains the name of the quantity, its value, its unit, and the subject (such as a
    site) to which the value belongs. If the value is unknown, the row contains the reason
    instead of the subject.

    Returns:
        The four cells of the row. Empty if the quantity cannot exist for this run, or if a
        missing value needs no explanation.
    """
    applicable = {
        subject: metric
        for subject, metric in metrics.values_of(quantity).items()
        if metric.applies
    }

    if not applicable:
        return []

    run_metric = metrics.run_value(quantity)
    if run_metric.value is None:
        is_known_for_some = any(metric.value is not None for metric in applicable.values())
        # A run that never settles gets a line, although no site has a settling time.
        needs_reason = quantity.key == "settle_s" or is_known_for_some
        if not needs_reason:
            return []
        reason = sanitize(run_metric.why)
        return [quantity.name, "–", quantity.unit, reason]

    subject = _name_subject(quantity, applicable)
    return [quantity.name, f"{run_metric.value:.4g}", quantity.unit, subject]


def _name_subject(quantity: Quantity, values: dict[str, Metric]) -> str:
    """Returns the name of the subject to which a value in the short table belongs.

    For a quantity with one value per site, the table shows only the largest value, and this is
    the name of that site, such as "m1". For a sum, it is "all sites together", and if all
    values are equal, "every site".
    """
    numbers = {subject: metric.value for subject, metric in values.items()}
    known_values = {subject: value for subject, value in numbers.items() if value is not None}
    if quantity.of == "run":
        return "run"
    if quantity.reduction == "sum":
        return f"all {quantity.of}s together"

    are_all_equal = len(set(known_values.values())) == 1
    if len(known_values) > 1 and are_all_equal:
        return f"every {quantity.of}"
    return max(known_values, key=lambda subject: known_values[subject])
