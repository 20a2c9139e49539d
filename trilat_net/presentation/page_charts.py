"""Renders the empty containers into which a report's scripts draw charts and arms.

The scripts `report.js` and `arms.js` fill the containers in the browser.

Invariant:
    - Each group of charts is collapsible. At most `_MOST_OPEN_CHARTS` charts are expanded
      initially.
    - The page lists the charts for which the log has no data.
"""

import tomllib
from collections.abc import Mapping, Sequence
from importlib import resources
from typing import Any

from markupsafe import Markup

from ..log import Log
from .charts import ChartBuilder
from .figures.age_and_lateness import explain_missing_loop_times
from .figures.arm_poses import render_arms_svg
from .figures.joint_motion import explain_absent_operator
from .html_templates import render_macro
from .page_data import Chart
from .page_html import render_details, render_note

_TEXTS: dict[str, dict[str, Any]] = tomllib.loads(
    (resources.files("trilat_net.presentation") / "assets" / "report.toml").read_text("utf-8")
)
"""Heading and note of each section of charts, keyed by part of the page and section, and other
notes.
"""
_OPEN_SECTIONS = ("torques", "errors", "positions")
"""Sections of charts that may be expanded initially."""
_MOST_OPEN_CHARTS = 10
"""Maximum number of charts in a part of the page that are expanded initially."""
_MOST_HALF_CHARTS = 2
"""Maximum number of charts in a group that occupies half the width of the page."""
_NO_VALUE = "the log has no value to draw"
"""Reason why a chart is omitted."""

_ARM_NOTE = (
    "Solid: the arm; dashed: where the other arms lead it, delayed and weighted. The arms "
    "follow the slider, and the pointer in any chart."
)


def render_overview(log: Log, builder: ChartBuilder, charts: Sequence[Chart]) -> Markup:
    """Renders the top of a report: the moving arms, who leads the slave, errors and delays.

    This part lets a reader understand the run without reading further.

    Args:
        log: Log of the run.
        builder: Builder of the charts, which provides the bounding box of the motion, and the
            scale of the pictures of the arms.
        charts: Charts of the page.
    """
    html = Markup()
    has_records = any(len(log[site]) for site in log.sites)
    if has_records:
        html += render_macro("charts.html", "arm_player")
        sentences = []
        for lead in builder.leads:
            if lead.is_constant:
                sentences.append(lead.describe_constant(log.scenario))
            else:
                html += lead.render_bar(log)
        html += render_note(" ".join([*sentences, _ARM_NOTE]))

    empty_sites = [site for site in log.sites if not len(log[site])]
    if empty_sites:
        html += render_note(f"Not drawn, because there is no record: {', '.join(empty_sites)}.")

    if any(chart.section == "overview" for chart in charts):
        html += render_macro("charts.html", "charts", section="overview", is_small=False)
    if has_records:
        pictures = render_arms_svg(log, builder.bounds_m, builder.units_per_m)
        summary = "The arms at a few instants, with the path of the end effector until then"
        html += render_details(summary, pictures)
    return html


def render_chart_groups(
    log: Log, place: str, charts: Sequence[Chart], missing: Mapping[str, Sequence[str]]
) -> Markup:
    """Renders the chart groups of a section, with a note about the missing charts.

    Only a limited number of charts is expanded initially, so that the page is drawn quickly.

    Args:
        log: Log of the run.
        place: Part of the page, given as the name of a table in `report.toml`, such as "motion"
            or "links".
        charts: Charts of the page.
        missing: Mapping from section to the titles of charts for which the log has no data.
    """
    has_chains = any(arm.chain for arm in log.scenario.arms.values())
    absence_reasons = {
        "torques": explain_absent_operator(log),
        "timing": explain_missing_loop_times(log),
    }

    rendered_groups = []
    missing_by_reason: dict[str, list[str]] = {}  # titles by the reason
    unfolded_count = 0
    for section, (heading, note) in _TEXTS[place].items():
        name = f"{heading[0].lower()}{heading[1:]}"

        count = sum(chart.section == section for chart in charts)
        if count:
            is_small = has_chains and section == "estimates"
            text = _TEXTS["notes"]["chain_estimates"] if is_small else note
            fits = unfolded_count + count <= _MOST_OPEN_CHARTS
            is_open = section in _OPEN_SECTIONS and fits
            unfolded_count += count if is_open else 0
            rendered_groups.append(
                _render_group(section, heading, text, count, is_open, is_small)
            )
            missing_by_reason.setdefault(_NO_VALUE, []).extend(missing.get(section, ()))
        elif absence_reasons.get(section):
            missing_by_reason.setdefault(absence_reasons[section], []).append(name)
        elif section in missing:
            missing_by_reason.setdefault(_NO_VALUE, []).append(name)

    groups = Markup()
    if rendered_groups:
        groups = render_macro("charts.html", "groups", groups=rendered_groups)
    if place == "loops":  # the section of the loops itself says which charts are missing
        return groups

    for reason, titles in missing_by_reason.items():
        if titles:
            groups += render_note(f"Not on this page, because {reason}: {'; '.join(titles)}.")
    return groups


def _render_group(
    section: str, heading: str, note: str, count: int, is_open: bool, is_small: bool
) -> Markup:
    """Renders a collapsible group of charts.

    The group is an empty container, which a script of the page fills with charts.

    Args:
        section: Key of the section, as in `report.toml`.
        heading: Heading of the group.
        note: Sentence about the charts.
        count: Number of charts.
        is_open: True to expand the group initially.
        is_small: True for small charts without legends, used if there are many.
    """
    return render_macro(
        "charts.html",
        "group",
        heading=heading,
        note=note,
        width="half" if count <= _MOST_HALF_CHARTS else "whole",
        is_open=is_open,
        section=section,
        is_small=is_small,
    )
