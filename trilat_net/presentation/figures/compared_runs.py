"""Draws a signal of several runs in the same axes, with one panel per arm and joint.

This can compare, for example, the angle of a joint for three delays. Lines have the colour of
their arm, and the dash pattern identifies the run: the first run is solid. The legend lists the
settings in which the runs differ.

Invariant:
    - A panel has one line for each run that has the arm and the joint.
"""

import textwrap
from collections.abc import Callable, Mapping
from typing import NamedTuple

from matplotlib.figure import Figure

from ...analysis import Timeline, site_signals
from ...core import Array
from ...errors import UsageError, count_nouns
from ...log import Log, SiteLog
from ...scenario import ScenarioDifference
from .. import plot_signals, style
from ..appearance import REPORT_SIZE, FigureSize
from .joint_motion import add_joint_rows, choose_height_in

_MOST_SETTINGS = 3
"""Maximum number of differing settings listed in the legend for each run."""
_FIRST_ALPHA = 0.45
"""Opacity of the lines of the first run."""
_LETTERS_PER_IN = 15.0
"""Average number of legend letters per inch."""


class _ComparedSignal(NamedTuple):
    """A quantity of the arms, such as the error, that a figure compares across runs.

    Attributes:
        name: Name for the labels of the value axes.
        find_unit: Function that returns the unit of the signal in a log.
        compute: Function that returns the signal of a site, shape (K, n).
        shares_poses: True if the columns are the coordinates that the sites exchange. In task
            space, these are the axes of the end effectors instead of joints.
    """

    name: str
    find_unit: Callable[[Log], str]
    compute: Callable[[SiteLog], Array]
    shares_poses: bool = False


COMPARED_SIGNALS = {
    "positions": _ComparedSignal("angle", lambda _: "rad", site_signals.joint_angles),
    "tracking_errors": _ComparedSignal(
        "error", plot_signals.shared_unit, site_signals.joint_errors, shares_poses=True
    ),
    "control_torques": _ComparedSignal(
        "torque", lambda _: "N m", site_signals.controller_torques
    ),
}
"""Signals that `draw_compared_runs` can draw, keyed by the figure name for a single run."""


def draw_compared_runs(
    logs: Mapping[str, Log], name: str, form: FigureSize = REPORT_SIZE
) -> Figure:
    """Draws a signal of several runs, such as the joint angles, in the same axes.

    There is one panel per arm and joint. The dash pattern of a line identifies the run.

    Args:
        logs: Mapping from the legend name of each run to its log.
        name: Name of the signal, one of `COMPARED_SIGNALS`.
        form: Width, font sizes and resolution of the figure.

    Raises:
        UsageError: There are more runs than dash patterns, or the runs have no site in common.
    """
    if len(logs) > len(style.DASHES):
        raise UsageError(
            f"{name} can be drawn for at most {count_nouns(len(style.DASHES), 'run')}, "
            f"not {len(logs)}; "
            "overlay can be drawn for more"
        )

    sites = list_common_sites(logs)
    if not sites:
        raise UsageError(f"{name}: the logs have no site in common")

    signal = COMPARED_SIGNALS[name]
    first_log = next(iter(logs.values()))
    titles = style.name_shared(first_log) if signal.shares_poses else []
    unit = signal.find_unit(first_log)
    # A narrow figure has no room for a label in one line.
    gap = "\n" if form.narrow else " "
    labels = [f"{signal.name}{gap}of {site} ({unit})" for site in sites]
    row_in = 0.95 if form.narrow else 1.25
    height_in = choose_height_in(first_log, 0.9 + row_in * len(sites))
    end_s = max(Timeline(log).end_s for log in logs.values())
    lines = [_style_run(number, form) for number in range(len(logs))]
    with style.styled_figure(form, height_in) as figure:
        grid, lowest = add_joint_rows(
            figure=figure,
            log=first_log,
            form=form,
            heads=labels,
            labels=labels,
            sharey="col",
            titles=titles,
        )
        for site, row in zip(sites, grid, strict=True):
            colour = style.site_colour(first_log, site)
            for log, run_line in zip(logs.values(), lines, strict=True):
                records = log[site]
                line = {"color": colour, **run_line}
                for axes, values in zip(row, signal.compute(records).T, strict=False):
                    style.plot_decimated(axes, records.tick, records.t_s, values, **line)
        for axes in lowest:
            axes.set_xlabel("time (s)")
            axes.set_xlim(0.0, end_s)
        entries: list[style.LegendEntry] = []
        for site in sites:
            colour = style.site_colour(first_log, site)
            entries.append((style.site_title(first_log, site), {"color": colour}))
        for label, run_line in zip(label_runs(logs, form).values(), lines, strict=True):
            entries.append((label, {"color": style.REFERENCE, **run_line}))
        style.add_legend(figure, entries)
    return figure


def _style_run(number: int, form: FigureSize) -> style.LineOptions:
    """Returns the line options for a run: dash pattern, width and opacity, but no colour.

    The first run is solid, wide and pale, so that dashed lines on top of it remain visible.

    Args:
        number: Index of the run, starting from 0.
        form: Size of the figure.
    """
    width_pt = 0.8 if form.narrow else 1.0
    if number == 0:
        return {
            "linestyle": style.DASHES[0],
            "linewidth": 2.0 * width_pt,
            "alpha": _FIRST_ALPHA,
        }
    return {"linestyle": style.DASHES[number], "linewidth": width_pt}


def list_common_sites(logs: Mapping[str, Log]) -> list[str]:
    """Lists the sites that are present in all compared runs, in the order of the first run.

    Args:
        logs: Mapping from the name of each run to its log.
    """
    first_log, *others = logs.values()
    return [site for site in first_log.sites if all(site in log.sites for log in others)]


def label_runs(logs: Mapping[str, Log], form: FigureSize) -> dict[str, str]:
    """Returns the legend label of each run: its name, and the settings in which it differs.

    An example is "slow: control.Kd = 3, every link 800 ms". Long labels are broken into lines.

    Args:
        logs: Mapping from the name of each run to its log.
        form: Size of the figure, whose width limits the length of a line.
    """
    scenarios = [log.scenario for log in logs.values()]
    differences = []
    if len(scenarios) > 1:
        differences = ScenarioDifference.list_between(scenarios)
    first_scenario = scenarios[0]
    letters_per_line = round(_LETTERS_PER_IN * form.width_in)
    labels = {}
    for number, name in enumerate(logs):
        settings = []
        for difference in differences[:_MOST_SETTINGS]:
            value = difference.values[number]
            if difference.concerns_link:
                settings.append(f"{difference} {value}")
            elif len(difference.owners) == len(first_scenario.sites):
                # All sites have the same value, so their names can be left out.
                settings.append(f"{difference.key} = {value}")
            else:
                settings.append(f"{difference} = {value}")
        if len(differences) > _MOST_SETTINGS:
            unlisted_count = len(differences) - _MOST_SETTINGS
            settings.append(f"and {count_nouns(unlisted_count, 'more setting')}")

        text = f"{name}: {', '.join(settings)}" if settings else name
        lines = textwrap.wrap(text, letters_per_line)
        labels[name] = style.typeset("\n".join(lines))
    return labels
