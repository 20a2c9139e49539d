"""Writes the report of a recorded run: a web page, and a file with the key figures of the run.

`write_report` computes the key figures of the run from its log, draws the figures that explain
whether the run was stable, and writes two files:

- `report.html`, a page for readers. `render_report` fills the template `templates/report.html`.
  The sections about links and sites are composed in this module, the others in the `page_...`
  modules. Scripts draw interactive charts in the browser from data computed by
  `charts.ChartBuilder`.
- `summary.json`, the same numbers for programs.

Invariant:
    - The page is a single file that contains its images, styles and scripts. It loads nothing
      from the network, so it can be sent by mail and read offline.
    - Every string that comes from a scenario or a log is escaped by the template that inserts
      it, and therefore cannot add HTML to the page.
    - The page has the same colours and typefaces as the live page, because both use
      `theme.css`.
    - Empty tables are omitted.
    - Sections about links or sites start with a sentence that gives the main results, and each
      table has a legend.
"""

import json
from collections.abc import Callable, Iterable, Mapping
from importlib import resources
from pathlib import Path

from markupsafe import Markup

from ..analysis import Certificate, summarise_run
from ..errors import count_nouns
from ..files import make_folder, write_whole
from ..log import CheckReport, Log
from ..results import JsonObject
from ..scenario import Scenario
from .appearance import SITE_COLOURS
from .charts import ChartBuilder
from .figures.age_and_lateness import explain_missing_loop_times
from .html_templates import render_macro, render_template
from .page_certificate import render_certificate
from .page_charts import render_chart_groups, render_overview
from .page_html import (
    NO_NUMBER,
    format_cell,
    render_details,
    render_folds,
    render_section,
    render_table,
)
from .page_origin import describe_changes, render_origin, summarise_origin
from .page_summary import render_alarms, render_checks, render_key_numbers, render_verdict
from .page_timeline import render_timeline
from .plot_signals import shared_unit
from .style import typeset

_ASSETS = resources.files("trilat_net.presentation") / "assets"


def write_report(
    log: Log,
    folder: Path,
    *,
    certificate: Certificate,
    wait_for_checks: Callable[[], CheckReport],
    twin: Log | None = None,
) -> list[Path]:
    """Writes the report of a run, report.html and summary.json, to a folder.

    The page presents the results to readers; the JSON file contains the same numbers for
    programs.

    Args:
        log: Log of the run.
        folder: Folder for both files. Created if it does not exist.
        certificate: Stability certificate of the run.
        wait_for_checks: Function that returns the results of the log checks. It is called only
            after the figures of the certificate are drawn, because another process may still be
            checking the log until then.
        twin: Log of the same run, simulated without operators. The page shows the difference,
            which is the motion caused by the operators. If `None`, this section is omitted.

    Returns:
        The paths of the page and of the summary.
    """
    make_folder(folder)
    facts = summarise_run(log, twin)
    facts["certificate"] = certificate.to_dict()
    reasons = render_certificate(log, certificate)

    checks = wait_for_checks()
    facts["checks"] = checks.to_rows()
    page = render_report(
        log=log,
        twin=twin,
        checks=checks,
        facts=facts,
        verdict=render_verdict(log, certificate, checks),
        reasons=reasons,
    )

    page_path = folder / "report.html"
    summary = json.dumps(facts, allow_nan=False, ensure_ascii=False, indent=2)
    summary_path = folder / "summary.json"
    write_whole(page_path, page)
    write_whole(summary_path, summary + "\n")
    return [page_path, summary_path]


def render_report(
    log: Log,
    twin: Log | None,
    checks: CheckReport,
    facts: JsonObject,
    verdict: Markup = Markup(),  # noqa: B008
    reasons: Markup = Markup(),  # noqa: B008
) -> Markup:
    """Composes the web page (HTML) that reports a run: verdict, charts and tables.

    Args:
        log: Log of the run.
        twin: Log of the same run without operators, or `None`, see `write_report`.
        checks: Results of the log checks.
        facts: Key figures of the run, from `summarise_run`.
        verdict: HTML of the stability verdict, shown at the top of the page. Empty for none.
        reasons: HTML of the section that explains the verdict. Empty to omit the section.

    Returns:
        The complete page.
    """
    scenario = log.scenario
    builder = ChartBuilder(log, twin)
    data, missing = builder.build()
    chart_groups = {}
    for place in ("motion", "links", "loops"):
        chart_groups[place] = render_chart_groups(log, place, data.charts, missing)

    return render_template(
        "report.html",
        name=scenario.name,
        title=scenario.title or scenario.name,
        origin_line=summarise_origin(log),
        changes=describe_changes(scenario),
        verdict=verdict,
        alarms=render_alarms(log),
        checks=render_checks(checks, facts),
        numbers=render_key_numbers(log, facts),
        overview=render_overview(log, builder, data.charts),
        motion=_render_motion(chart_groups["motion"]),
        timeline=render_timeline(log, facts),
        links=_render_links(log, facts, chart_groups["links"]),
        sites=_render_sites(log, facts),
        reasons=reasons,
        loops=_render_loops(log, facts, chart_groups["loops"]),
        origin=render_origin(log, facts, _read_asset("uPlot-LICENSE")),
        data=data.to_builtins(),
        css=_read_asset("theme.css") + _read_asset("report.css"),
        site_css=_render_site_css(scenario),
        js=_read_asset("report.js") + _read_asset("arms.js"),
        uplot_css=_read_asset("uPlot.min.css"),
        uplot_js=_read_asset("uPlot.iife.min.js"),
    )


def _read_asset(name: str) -> Markup:
    """Returns the contents of an asset of the page, such as a style sheet or a script."""
    return Markup((_ASSETS / name).read_text(encoding="utf-8"))


def _render_motion(charts: Markup) -> Markup:
    """Renders the section with positions, torques and estimates. Empty if it has no charts."""
    if not charts:
        return Markup()
    intro = (
        "Drag over a chart to zoom all, double-click to see the whole run, click a name to "
        "hide its line. Fig. 3 to 6 correspond to the paper's figures of the same numbers."
    )
    heading = "Positions, torques and estimates over time"
    return render_section(heading, intro, charts, "figures")


def _render_site_css(scenario: Scenario) -> Markup:
    """Returns the CSS rules for the colours of the sites, which `theme.css` defines.

    The site with index i has the class `site-i` for lines in its colour, and `fill-i` for areas
    in its colour. Colours repeat if there are more sites than colours.
    """
    colour_numbers = scenario.assign_colours(len(SITE_COLOURS))
    rules = ""
    for index in range(len(scenario.sites)):
        css_colour = f"var(--site-{colour_numbers[index % len(colour_numbers)]})"
        rules += f".site-{index} {{ stroke: {css_colour}; }} "
        rules += f".fill-{index} {{ background: {css_colour}; fill: {css_colour}; }}\n"
    return Markup(rules)


_AGE_COLUMNS = {
    "link": "",
    "stated delay": "delay model of the scenario, and its changes",
    "in use, mean (ms)": "mean age of the samples in use, over all ticks",
    "deviation": "standard deviation of this age",
    "p50": "median of this age",
    "p99": "age that 99 % of the ticks do not exceed",
    "min": "least age",
    "max": "largest age",
    "nothing new (% of ticks)": "share of the ticks in which no new sample came into use",
    "longest silence (ms)": "longest time between two new samples",
}
_AGE_KEYS = ("mean", "deviation", "p50", "p99", "min", "max")
_SAMPLE_COLUMNS = {
    "sent": ("sent", "samples that the sender published"),
    "missing": (
        "missing on the way",
        "samples that were sent, but that the network did not deliver",
    ),
    "lost": ("lost by the model", "samples that the delay model lost"),
    "late": ("late", "samples that arrived after the model's delay had passed"),
    "superseded": ("superseded", "never used, because a newer sample came into use before"),
    "duplicate": ("duplicates", "samples that arrived twice"),
    "copies": ("of the model", "duplicates that the delay model made"),
}
"""Header and meaning of each count of a link, keyed by its name in the summary."""
_LOSS_COLUMNS = {
    "lost in all (%)": "share of the samples that could not come into use",
    "in a row": "mean number of samples that were lost together",
}
_ONE_WAY_COLUMNS = {
    "one way, min (µs)": "least measured time from sender to receiver",
    "p50": "median of this time",
    "p99": "time that 99 % of the samples do not exceed",
    "max": "largest time",
    "known to, p50 (µs)": "median of the error bound of these times",
}
_CLOCK_COLUMNS = {
    "offset_us": ("ahead at the end (µs)", "clock of the sender minus that of the receiver"),
    "offset_first_us": ("at the start", "the same difference at the start"),
    "drift_ppm": ("drift (ppm)", "rate of the difference"),
    "drift_bound_ppm": ("known to (ppm)", "error bound of the drift"),
    "bound_us": ("offset known to, end (µs)", "error bound of the difference at the end"),
    "bound_p50_us": ("p50", "median of this bound"),
    "bound_max_us": ("max", "largest value of this bound"),
    "rtt_min_us": ("round trip, min (µs)", "shortest time to the peer and back"),
    "faults": ("faults", "samples that arrived before they were sent"),
}
"""Header and meaning of each clock value of a sender, keyed by its name in the summary."""


def _render_links(log: Log, facts: JsonObject, charts: Markup = Markup()) -> Markup:  # noqa: B008
    """Renders the section about network links: a sentence, and tables of ages and losses.

    Another table compares the clocks of the machines.

    Args:
        log: Log of the run.
        facts: Key figures of the run, from `summarise_run`.
        charts: HTML of the charts about the links. Empty for no charts.
    """
    rows = _list_age_rows(log, facts)
    ages = render_table(_AGE_COLUMNS, rows, text_columns=[1]) + _render_legend(_AGE_COLUMNS)
    heading = "Age of the samples in use, by link"
    folds = [
        render_details(heading, ages),
        render_details("Samples sent, lost and superseded", _render_samples(log, facts)),
    ]

    clocks = _render_clocks(log, facts)
    if clocks:
        folds.append(render_details("Clocks of the senders, seen by the receivers", clocks))

    body = render_folds(folds) + charts
    return render_section("Links", _summarise_links(facts), body, "links")


def _summarise_links(facts: JsonObject) -> str:
    """Returns a sentence about communication: specified delays, sample ages, and losses.

    For example: "Every link has the delay model ...; the controllers used samples that were 400
    to 402 ms old, and no sample was lost."
    """
    links: dict[str, JsonObject] = facts["links"]
    models: set[str] = set()
    for link in links.values():
        models |= {model["link"] for model in link["stated"]}
    stated_text = f"{count_nouns(len(links), 'link')} with {len(models)} different delay models"
    if len(models) == 1:
        stated_text = f"Every link has the delay model “{typeset(*models)}”"

    ages_ms = [link["age_ms"] for link in links.values() if link["age_ms"]["max"] is not None]
    if not ages_ms:
        return f"{stated_text}; no sample came into use."

    youngest_ms = format_cell(min(age["min"] for age in ages_ms))
    oldest_ms = format_cell(max(age["max"] for age in ages_ms))
    used_text = f"the controllers used samples that were {youngest_ms} to {oldest_ms} ms old"
    if youngest_ms == oldest_ms:
        used_text = f"the controllers used samples that were {oldest_ms} ms old"

    loss_by_link = {name: link["loss"] for name, link in links.items() if link["loss"]}
    if not loss_by_link:
        return f"{stated_text}; {used_text}, and no sample was lost."

    worst_link = max(loss_by_link, key=lambda name: loss_by_link[name])
    lost_percent = format_cell(_to_percent(loss_by_link[worst_link]))
    return (
        f"{stated_text}; {used_text}, and up to {lost_percent} % were lost "
        f"(on {typeset(worst_link)})."
    )


def _list_age_rows(log: Log, facts: JsonObject) -> list[list[str]]:
    """Returns table rows with the specified delay and the sample ages of each link.

    If the scenario changes the delay of a link during the run, the cell lists all delays with
    the times from which they applied.
    """
    rows = []
    for name, link in facts["links"].items():
        first_model, *later_models = link["stated"]
        model_texts = [first_model["link"]]
        model_texts += [
            f"from {change['from_s']:g} s: {change['link']}" for change in later_models
        ]
        stated_cell = render_macro(
            "origin.html", "stated_delays", models=[typeset(model) for model in model_texts]
        )

        numbers = [link["age_ms"][key] for key in _AGE_KEYS]
        numbers += [_to_percent(link["ticks_without_new"]), link["silence_ms"]]
        rows.append([_label_link(log, name), stated_cell, *map(format_cell, numbers)])
    return rows


def _render_samples(log: Log, facts: JsonObject) -> Markup:
    """Renders the table of delivered and lost samples of each link.

    The columns with measured one-way delays are included only if at least one link has them.
    """
    links: dict[str, JsonObject] = facts["links"]
    is_measured = any(link["one_way_us"] for link in links.values())
    columns = {"link": "", **dict(_SAMPLE_COLUMNS.values()), **_LOSS_COLUMNS}
    if is_measured:
        columns |= _ONE_WAY_COLUMNS
    rows = []
    for name, link in links.items():
        counts: JsonObject = link["samples"] or {}
        numbers = [counts.get(key) for key in _SAMPLE_COLUMNS]
        numbers += [_to_percent(link["loss"]), link["burst"]]
        if is_measured:
            one_way_us = link["one_way_us"] or {}
            clock = link["clock"] or {}
            numbers += [one_way_us.get(key) for key in ("min", "p50", "p99", "max")]
            numbers.append(clock.get("bound_p50_us"))
        rows.append([_label_link(log, name), *map(format_cell, numbers)])
    return render_table(columns, rows) + _render_legend(columns)


def _render_clocks(log: Log, facts: JsonObject) -> Markup:
    """Renders a table of the clock differences between the machines of a session.

    Measured one-way delays are only as accurate as the estimates of these differences.

    Args:
        log: Log of the run.
        facts: Key figures of the run, from `summarise_run`.

    Returns:
        HTML of the table. Empty if all sites use the same clock.
    """
    rows = []
    for name, link in facts["links"].items():
        clock: JsonObject = link["clock"] or {}
        # Two sites that read the same clock know its offset exactly: it is zero.
        is_other_clock = clock and (clock["bound_max_us"] or clock["offset_us"])
        if is_other_clock:
            cells = [format_cell(clock[key]) for key in _CLOCK_COLUMNS]
            rows.append([_label_link(log, name), *cells])
    if not rows:
        return Markup()

    columns = {"clock of the sender": "", **dict(_CLOCK_COLUMNS.values())}
    return render_table(columns, rows) + _render_legend(columns)


# Keys of a site in the summary, in the order of the columns of its table.
_MOTION_KEYS = (
    "max_error_rad",
    "max_error_end_rad",
    "settle_s",
    "peak_tau_nm",
    "saturated_ticks",
)
_MOST_OPEN_ROWS = 4
"""Maximum number of sites for which the table is expanded."""
_ANGLE_COLUMNS = {
    "site": "",
    "q at the end (rad)": "angle of each joint at the last record",
    "moved by operators, max (rad)": "largest difference of each joint from the same run "
    "without operators",
}


def _render_sites(log: Log, facts: JsonObject) -> Markup:
    """Renders the section of a report with tables of the motion and records of each arm.

    The tables show how well each arm followed the others, and how hard its controller worked.

    Args:
        log: Log of the run.
        facts: Key figures of the run, from `summarise_run`.
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
        label = _label_site(log, name)
        counts = [str(site["records"]), str(site["missing"])]
        motion_cells = [format_cell(site[key]) for key in _MOTION_KEYS]
        rows.append([label, *counts, *motion_cells])

        end_angles = _format_numbers(site["q_end_rad"])
        moved_angles = _format_numbers(site["hands_moved_max_rad"])
        angle_rows.append([label, end_angles, moved_angles])

    table = render_table(columns, rows)
    is_open = len(rows) <= _MOST_OPEN_ROWS
    errors = render_details("Errors and torques, by site", table, is_open=is_open)

    angles = render_table(_ANGLE_COLUMNS, angle_rows, text_columns=(1, 2))
    angles += _render_legend(_ANGLE_COLUMNS)
    summary = "Where the arms ended, and how far operators moved them"
    meanings = render_details("What the columns mean", _render_legend(columns))
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


def _render_loops(log: Log, facts: JsonObject, charts: Markup = Markup()) -> Markup:  # noqa: B008
    """Renders the section of the report about the timing of each site's control loop.

    The section shows how punctual the ticks were, and how long their computation took.

    Args:
        log: Log of the run.
        facts: Key figures of the run, from `summarise_run`.
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
        rows.append([_label_site(log, name), *cells])

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
    table = render_table(_LOOP_COLUMNS, rows) + _render_legend(_LOOP_COLUMNS)
    body = render_details("Lateness and computing time, by loop", table) + charts
    return render_section("Loop timing", intro, body, "loops")


def _render_legend(columns: Mapping[str, str]) -> Markup:
    """Renders the explanations of a table's columns as a line of text, for touch screens.

    On other screens, an explanation is shown while the pointer hovers over the column header.

    Args:
        columns: Mapping from column header to its explanation. Columns with an empty
            explanation are omitted.

    Returns:
        The line. Empty if no column has an explanation.
    """
    items = [f"{header}: {meaning}" for header, meaning in columns.items() if meaning]
    return render_macro("parts.html", "legend", text="; ".join(items)) if items else Markup()


def _label_site(log: Log, name: str) -> Markup:
    """Renders the label of a site in a table, for example "m1 (master)".

    The label is preceded by a square in the colour that the site has in all charts.
    """
    role = log.scenario.sites[name].role
    return render_macro(
        "parts.html", "labelled", index=log.sites.index(name), text=f"{name} ({role})"
    )


def _label_link(log: Log, link: str) -> Markup:
    """Renders the label of a link in a table, for example "m1 → s" for the link "m1->s".

    The label is preceded by a square in the colour of the sending site.
    """
    peer, site = link.split("->")
    return render_macro(
        "parts.html", "labelled", index=log.sites.index(peer), text=f"{peer} → {site}"
    )


def _format_numbers(values: Iterable[float] | None) -> str:
    """Formats numbers as one table cell, for example "0.1000, -0.2500".

    `None`, for missing values, becomes a dash.
    """
    if values is None:
        return NO_NUMBER
    return ", ".join(f"{value:.4f}" for value in values)


def _to_percent(share: float | None) -> float | None:
    """Converts a fraction to percent: 0.05 becomes 5, and `None` (unknown) remains `None`."""
    return None if share is None else 100.0 * share
