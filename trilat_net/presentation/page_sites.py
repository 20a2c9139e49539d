"""Renders the sections of a report about each arm: its motion, and the timing of its loop.

A record is the stored state of an arm in one period (tick) of its control loop.

Invariant:
    - Each section begins with a sentence, and each table has a legend.
"""

from markupsafe import Markup

from ..errors import count_nouns
from ..log import Log
from ..results import JsonObject
from .figures.age_and_lateness import explain_missing_loop_times
from .page_html import (
    NO_NUMBER,
    format_cell,
    format_numbers,
    label_site,
    render_details,
    render_folds,
    render_legend,
    render_section,
    render_table,
)
from .plot_signals import shared_unit

# Keys of a site in the summary, in the order of the columns of its table.
_MOTION_KEYS = (
    "max_error_rad",
    "max_error_end_rad",
    "settle_s",
    "peak_tau_nm",
    "saturated_ticks",
)
_MOST_OPEN_ROWS = 4
"""Largest number of sites for which the table is not folded."""
_ANGLE_COLUMNS = {
    "site": "",
    "q at the end (rad)": "angle of each joint at the last record",
    "moved by operators, max (rad)": "largest difference of each joint from the same run "
    "without operators",
}


def render_sites(log: Log, facts: JsonObject) -> Markup:
    """Renders the section of a report with tables of the motion and records of each arm.

    The tables show how well each arm followed the others, and how hard its controller worked.

    Args:
        log: Log of the run.
        facts: Numbers of the run, from `summarise_run`.
    """
    unit = shared_unit(log)
    limit = f"{facts['settle_below_rad']:g} {unit}"
    columns = {
        "site": "",
        "records": "ticks in the log",
        "missing": "ticks that the log lacks",
        f"max |e| ({unit})": "largest error, e = q − q_des",
        f"max |e|, last 1 s ({unit})": "largest error of the last second",
        f"|e| < {limit} from (s)": "time from which all errors stay below this limit",
        "max |τ| (N\u00a0m)": "largest control torque",
        "ticks at the limit": "ticks with a torque at tau_limit_nm",
    }

    rows = []
    angle_rows = []
    for name in log.sites:
        site: JsonObject = facts["sites"][name]
        label = label_site(log, name)
        counts = [str(site["records"]), str(site["missing"])]
        motion_cells = [format_cell(site[key]) for key in _MOTION_KEYS]
        rows.append([label, *counts, *motion_cells])

        end_angles = format_numbers(site["q_end_rad"])
        moved_angles = format_numbers(site["hands_moved_max_rad"])
        angle_rows.append([label, end_angles, moved_angles])

    table = render_table(columns, rows)
    is_open = len(rows) <= _MOST_OPEN_ROWS
    errors = render_details("Errors and torques, by site", table, is_open=is_open)

    angles = render_table(_ANGLE_COLUMNS, angle_rows, text_columns=(1, 2))
    angles += render_legend(_ANGLE_COLUMNS)
    summary = "Where the arms ended, and how far operators moved them"
    meanings = render_details("What the columns mean", render_legend(columns))
    body = render_folds([errors, meanings, render_details(summary, angles)])
    intro = "How well each site followed its peers, and how hard its controller worked."
    return render_section("Sites", intro, body, "sites")


_LATENESS = "time between the moment at which a tick was due and its start"
_LOOP_COLUMNS = {
    "loop": "",
    "late p50 (µs)": f"median {_LATENESS}",
    "late p99 (µs)": "value that 99 % of the ticks do not exceed",
    "late p99.9 (µs)": "value that 99.9 % of the ticks do not exceed",
    "late max (µs)": "largest value",
    "busy p50 (µs)": "median computing time of a tick",
    "busy p99 (µs)": "value that 99 % of the ticks do not exceed",
    "busy max (µs)": "largest value",
    "overruns": "ticks that began late by a period or more, and were executed nevertheless: a "
    "simulated arm catches up",
    "skipped": "ticks that were not executed: a site with an external arm skips the ticks that "
    "it missed",
}


def render_loops(log: Log, facts: JsonObject, charts: Markup = Markup()) -> Markup:  # noqa: B008
    """Renders the section of the report about the timing of each site's control loop.

    The section shows how punctual the ticks (control periods) were, and how long they took to
    compute.

    Args:
        log: Log of the run.
        facts: Numbers of the run, from `summarise_run`.
        charts: HTML of the charts about the loops. Empty for no charts.
    """
    reason = explain_missing_loop_times(log)
    if reason:
        return render_section("Loop timing", f"Not measured: {reason}.", Markup(), "loops")

    rows = []
    overrun_count = 0
    skipped_count = 0
    largest_lateness_us = 0.0
    for name in log.sites:
        site: JsonObject = facts["sites"][name]
        lateness_us = site["late_us"]
        numbers = [lateness_us[key] for key in ("p50", "p99", "p99_9", "max")]
        numbers += [site["busy_us"][key] for key in ("p50", "p99", "max")]
        numbers += [site["overruns"], site["skipped"]]

        cells = [NO_NUMBER if value is None else f"{value:.0f}" for value in numbers]
        rows.append([label_site(log, name), *cells])

        overrun_count += site["overruns"] or 0
        skipped_count += site["skipped"]
        largest_lateness_us = max(largest_lateness_us, lateness_us["max"] or 0.0)

    verb = "was" if overrun_count == 1 else "were"
    intro = (
        f"The latest tick began {largest_lateness_us / 1e3:.3g} ms after it was due; "
        f"{count_nouns(overrun_count, 'tick')} began a period or more late and "
        f"{verb} executed nevertheless; "
        f"{count_nouns(skipped_count, 'tick was', 'ticks were')} skipped."
    )
    table = render_table(_LOOP_COLUMNS, rows) + render_legend(_LOOP_COLUMNS)
    body = render_details("Lateness and computing time, by loop", table) + charts
    return render_section("Loop timing", intro, body, "loops")
