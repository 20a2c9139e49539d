"""Composes the tables of the metrics of a run.

Invariant:
    - Missing numbers are shown as a dash. If the quantity is meaningful for the run, the reason
      why it is missing is given below the tables.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from itertools import groupby

from ..analysis import LogMetrics, Metric, Quantity
from .result_text import Block, MarkedText, TextTable
from .untrusted_text import sanitize

_NO_NUMBER = "–"
"""Cell content for a missing number."""
_MAX_FREQUENCIES = 16
"""Maximum number of frequencies listed for a response. The JSON output contains all."""


def compose_metrics(metrics: LogMetrics) -> Iterator[Block]:
    """Yields the tables with the metrics of a run.

    There is one table per group of quantities, with one column per subject: the run, an arm, a
    link, or a wall. Further tables describe what operators feel: forces, stiffness and
    impedance. The reasons for missing numbers come last.

    Args:
        metrics: The metrics of the run.
    """
    reasons: dict[str, list[str]] = {}
    tables = groupby(Quantity.list_all(), key=lambda quantity: (quantity.group, quantity.of))
    for (group, _), group_quantities in tables:
        yield from _compose_group(group, list(group_quantities), metrics, reasons)
    yield from _compose_sharing(metrics)
    yield from _compose_stiffness(metrics)
    yield from _compose_impedance(metrics)
    for reason, missing_names in reasons.items():
        yield _explain_missing(sanitize(", ".join(missing_names)), reason)


def _explain_missing(subject: str, reason: str) -> MarkedText:
    """Returns a dash, which stands for missing numbers, with the reason."""
    return MarkedText(f"[bold]{_NO_NUMBER}[/bold]", f"{subject}: {sanitize(reason)}")


def _compose_group(
    group: str, members: Sequence[Quantity], metrics: LogMetrics, reasons: dict[str, list[str]]
) -> Iterator[Block]:
    """Yields a table of metrics with one row per quantity and one column per arm, link or wall.

    Rows and columns without any applicable numbers are omitted.

    Args:
        group: Heading of the table.
        members: Quantities of the group, all for the same kind of subject.
        metrics: Metrics of the run.
        reasons: Mapping from reason to the names of missing numbers, which is extended in
            place.
    """
    values = {quantity: metrics.values_of(quantity) for quantity in members}
    applicable = {
        quantity: by_subject
        for quantity, by_subject in values.items()
        if _apply_any(by_subject.values())
    }

    # All quantities of a group have the same subjects.
    all_subjects = next(iter(values.values()))
    subjects = [
        subject
        for subject in all_subjects
        if _apply_any(by_subject[subject] for by_subject in applicable.values())
    ]
    if not subjects:
        return

    rows = []
    for quantity, by_subject in applicable.items():
        numbers = [_format_metric(by_subject[subject]) for subject in subjects]
        rows.append([quantity.name, quantity.unit, *numbers])
    yield from _tabulate([group, "", *subjects], rows, text_columns=2)

    for quantity, by_subject in applicable.items():
        for subject in subjects:
            metric = by_subject[subject]
            if metric.value is None and metric.applies:
                name = f"{quantity.name} of {subject}" if subject else quantity.name
                reasons.setdefault(metric.why, []).append(name)


def _compose_sharing(metrics: LogMetrics) -> Iterator[Block]:
    """Yields a table of the forces that an arm at rest feels while another arm is pushed.

    The expected force follows from the dominance factors. Yields nothing if no arm was at rest
    while another one was pushed.
    """
    if not metrics.sharing_ratios:
        return

    joint_header = "joint"
    unit = "N m"
    if metrics.axes:
        joint_header = "axis"
        unit = metrics.unit("N m", 1)

    rows = []

    for pair in metrics.sharing_ratios:
        wall_note = " (wall)" if pair.by_wall else ""
        deviation = _NO_NUMBER if pair.off is None else f"{100.0 * pair.off:.3g} %"
        row = [
            f"{pair.from_s:.1f} - {pair.to_s:.1f} s",
            metrics.label(pair.joint),
            f"{pair.pushed}{wall_note}",
            _format_value(pair.pushed_nm),
            pair.holds,
            _format_value(pair.felt_nm),
            _format_metric(pair.expected_nm),
            deviation,
        ]
        rows.append(row)

    headers = (
        "at rest",
        joint_header,
        "ON the arm of",
        unit,
        "felt at",
        unit,
        "expected",
        "deviation",
    )
    yield from _tabulate(headers, rows, text_columns=1)
    # Each reason is written once, in the order of the rows.
    reasons = dict.fromkeys(pair.expected_nm.why for pair in metrics.sharing_ratios)
    for reason in reasons:
        if reason:
            yield _explain_missing("nothing is expected", reason)


def _compose_stiffness(metrics: LogMetrics) -> Iterator[Block]:
    """Yields a table of the stiffness that operators felt at the arms.

    The stiffness is the change in an operator's torque over the change in joint angle, for
    example against a wall that another arm touches. Yields nothing if no stiffness was
    measured.
    """
    if not metrics.stiffness:
        return

    rows = []
    for measurement in metrics.stiffness:
        stiffness = _NO_NUMBER
        if measurement.stiffness_nm_rad is not None:
            stiffness = _format_value(measurement.stiffness_nm_rad)
        row = [
            f"{measurement.from_s:.1f} to {measurement.to_s:.1f} s",
            metrics.label(measurement.joint),
            measurement.site,
            _format_value(measurement.torque_nm),
            _format_value(measurement.angle_rad),
            stiffness,
        ]
        rows.append(row)

    headers = (
        "stiffness felt",
        "axis" if metrics.axes else "joint",
        "by",
        f"{metrics.unit('N m', 1)} more",
        f"{metrics.unit('rad', 1)} further",
        metrics.unit("N m/rad", 1),
    )
    yield from _tabulate(headers, rows, text_columns=1)


def _compose_impedance(metrics: LogMetrics) -> Iterator[Block]:
    """Yields a table of the impedance felt at the sites, with one row per frequency.

    The impedance is the ratio of force to motion as a function of frequency. At most about
    `_MAX_FREQUENCIES` frequencies are listed. Yields nothing if no impedance was measured.
    """
    if not metrics.responses:
        return

    rows = []
    for response in metrics.responses:
        direction = "along" if metrics.axes else "joint"
        source_text = f" of {response.of}" if response.of else ""
        axis = f"{direction} {metrics.label(response.joint)}"
        title = f"{response.kind}{source_text} at {response.at}, {axis}"
        unit = metrics.unit(response.unit, response.joint)
        listed_ratios = response.spectrum if len(response.spectrum) > 1 else [response.ratio]
        # Every step-th ratio is listed. The step is rounded up, so that at most
        # _MAX_FREQUENCIES ratios are listed.
        step = math.ceil(len(listed_ratios) / _MAX_FREQUENCIES)
        for index, ratio in enumerate(listed_ratios[::step]):
            shown_title = title if index == 0 else ""
            # If the ratio could not be estimated, the last cell has the reason.
            cells = ["", "", "", "", ratio.why]
            if ratio.gain is not None:
                numbers = (ratio.frequency_hz, ratio.gain, ratio.phase_rad, ratio.coherence)
                cells = [_format_value(number or 0.0) for number in numbers]
                error = _NO_NUMBER if ratio.error is None else f"{100.0 * ratio.error:.1g} %"
                cells.append(f"+- {error}")
            rows.append([shown_title, unit, *cells])
    headers = ["felt over frequency", "", "Hz", "gain", "phase rad", "coherence", ""]
    yield from _tabulate(headers, rows, text_columns=2)


def _apply_any(metrics: Iterable[Metric]) -> bool:
    """Returns True if at least one of the metrics is meaningful for the run."""
    return any(metric.applies for metric in metrics)


def _format_metric(metric: Metric) -> str:
    """Formats the value of a metric with four digits, or as a dash if there is no value."""
    return _NO_NUMBER if metric.value is None else _format_value(metric.value)


def _format_value(value: float) -> str:
    """Formats a number with four digits, or with all digits if it is an integer."""
    is_whole = value == int(value) and abs(value) < 1e6
    return f"{value:.0f}" if is_whole else f"{value:.4g}"


def _tabulate(
    heads: Sequence[str], rows: Iterable[Sequence[str]], text_columns: int
) -> Iterator[Block]:
    """Yields a table followed by an empty line for the terminal.

    Args:
        heads: Header of each column. If the last header is empty, the last column contains
            text.
        rows: Cells of each row.
        text_columns: Number of columns on the left that contain text and are left-aligned. The
            other columns contain numbers and are right-aligned.
    """
    last_letter = "r" if heads[-1] else "l"
    alignment = "l" * text_columns + "r" * (len(heads) - text_columns - 1) + last_letter
    yield TextTable(heads, list(rows), alignment)
    yield ""
