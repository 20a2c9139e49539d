"""Renders the section of a report about communication: delays, losses and clocks.

A link is the directed connection from one arm to another. Over a link, an arm sends its state
in each period of its control loop. Such a state is called a sample. The age of a sample is the
time since it was sent, and thus the delay that the controller of the receiver experiences.

Invariant:
    - A sentence with the main results precedes the tables, and each table has a legend.
    - Empty tables are left out.
"""

from markupsafe import Markup

from ..errors import count_nouns
from ..log import Log
from ..results import JsonObject
from .html_templates import render_macro
from .page_html import (
    format_cell,
    label_link,
    render_details,
    render_folds,
    render_legend,
    render_section,
    render_table,
    to_percent,
)
from .style import typeset

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
"""Header and meaning of each count of a link, by its key in the summary."""
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
"""Header and meaning of each value of a sender's clock, by its key in the summary."""


def render_links(log: Log, facts: JsonObject, charts: Markup = Markup()) -> Markup:  # noqa: B008
    """Renders the section about network links: a sentence, and tables of ages and losses.

    A further table compares the clocks of the machines.

    Args:
        log: Log of the run.
        facts: Numbers of the run, from `summarise_run`.
        charts: HTML of the charts about the links. Empty for no charts.
    """
    rows = _list_age_rows(log, facts)
    ages = render_table(_AGE_COLUMNS, rows, text_columns=[1]) + render_legend(_AGE_COLUMNS)
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
    """Returns a sentence about the communication: stated delays, ages of messages, and losses.

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
    lost_percent = format_cell(to_percent(loss_by_link[worst_link]))
    return (
        f"{stated_text}; {used_text}, and up to {lost_percent} % were lost "
        f"(on {typeset(worst_link)})."
    )


def _list_age_rows(log: Log, facts: JsonObject) -> list[list[str]]:
    """Returns table rows with each network link's stated delay and the ages of its messages.

    The scenario may change the delay of a link during the run. In this case the cell lists all
    stated delays, each with the time from which it applied.
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
        numbers += [to_percent(link["ticks_without_new"]), link["silence_ms"]]
        rows.append([label_link(log, name), stated_cell, *map(format_cell, numbers)])
    return rows


def _render_samples(log: Log, facts: JsonObject) -> Markup:
    """Renders the table of delivered and lost messages of each network link.

    The columns with measured one-way delays are added only if at least one link has them.
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
        numbers += [to_percent(link["loss"]), link["burst"]]
        if is_measured:
            one_way_us = link["one_way_us"] or {}
            clock = link["clock"] or {}
            numbers += [one_way_us.get(key) for key in ("min", "p50", "p99", "max")]
            numbers.append(clock.get("bound_p50_us"))
        rows.append([label_link(log, name), *map(format_cell, numbers)])
    return render_table(columns, rows) + render_legend(columns)


def _render_clocks(log: Log, facts: JsonObject) -> Markup:
    """Renders a table of the clock differences between the machines of a session.

    Measured one-way delays are only as accurate as the estimates of these differences.

    Args:
        log: Log of the run.
        facts: Numbers of the run.

    Returns:
        HTML of the table. Empty if all sites read the same clock.
    """
    rows = []
    for name, link in facts["links"].items():
        clock: JsonObject = link["clock"] or {}
        # Two sites that read the same clock know its offset exactly: it is zero.
        is_other_clock = clock and (clock["bound_max_us"] or clock["offset_us"])
        if is_other_clock:
            cells = [format_cell(clock[key]) for key in _CLOCK_COLUMNS]
            rows.append([label_link(log, name), *cells])
    if not rows:
        return Markup()

    columns = {"clock of the sender": "", **dict(_CLOCK_COLUMNS.values())}
    return render_table(columns, rows) + render_legend(columns)
