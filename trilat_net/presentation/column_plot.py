"""Plots columns of a log over time; this is the implementation of `Log.plot`.

A column is one recorded quantity of an arm, such as the angle of its first joint. For example,
`log.plot("q1", "tau1")` plots the angle and the torque of the first joint of every arm. A name
can refer to

- a quantity, such as "q", which selects all columns of the quantity,
- a column without its unit, such as "q1",
- a column, such as "q1_rad".

Invariant:
    - Names are those of the tables of the log (`Log.table`), and "e" for the error.
    - There is one panel per column, with one line for each selected arm that has the column.
    - An unknown name raises an error that lists the valid names.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ..analysis import Timeline
from ..core import Array
from ..errors import UnknownName, UsageError, suggest_nearest
from ..log import Column, Ints, Log
from ..log.ros2 import NUMBERS_BY_MODE_WORD
from ..scenario import TASK_AXES
from . import style
from .appearance import REPORT_SIZE
from .figures.registry import FIGURES
from .figures.run_overview import draw_overview

DEFAULT_QUANTITIES = ("q", "e", "tau")
"""Quantities to plot if sites, joints or times are selected, but no columns."""
_JOINT_QUANTITIES = ("q", "qd", "q_des", "qd_des", "tau", "tau_x", "e")
"""Quantities with one column per joint, named after the number of the joint."""
_QUANTITIES_BY_SOURCE = {"ch.": "ch", "used.": "used", "t_ns, used.": "age"}
"""Quantities with one column per peer or vector, keyed by the prefix of the column's source."""
_MARGIN_IN = 0.7
"""Height of the time axis and the legend, in inches."""
_ROW_IN = 1.25
"""Height of a row of panels, in inches."""

Joints = int | str | Sequence[int | str] | None
"""Joint numbers, counted from 1, or joint names. `None` for all joints."""


class _Line(NamedTuple):
    """One table column of an arm over time, plotted as a line.

    A panel has one such line for each arm that has the column.

    Attributes:
        site: Name of the site.
        tick: Numbers of the ticks, shape (K,).
        t_s: Times of the ticks, in s, shape (K,).
        column: The column, with K rows.
    """

    site: str
    tick: Ints
    t_s: Array
    column: Column


_Panels = dict[str, list[_Line]]
"""Mapping from column name to the lines of its panel."""


def plot_log(
    log: Log,
    names: Sequence[str] = (),
    *,
    sites: str | Iterable[str] | None = None,
    joints: Joints = None,
    from_s: float | None = None,
    until_s: float | None = None,
) -> Figure:
    """Plots columns of a log over time, with one panel per column and one line per arm.

    For example, `plot_log(log, ["q1", "tau1"])` plots the angle and the torque of the first
    joint of every arm. If nothing is selected, the figure is the overview of the run.

    Args:
        log: The log.
        names: Names of quantities or columns. Each name gets its own rows of panels.
        sites: Names of the arms to plot. `None` for all arms.
        joints: Joints to plot, for quantities with one column per joint.
        from_s: Start of the plotted interval, in s. `None` for the start of the run.
        until_s: End of the plotted interval, in s. `None` for the end of the run.

    Raises:
        UnknownName: There is no such column, arm or joint.
        UsageError: The interval contains no records.
        LogError: The records cannot be read.
    """
    is_restricted = not (
        sites is None and joints is None and from_s is None and until_s is None
    )
    if not names and not is_restricted:
        return draw_overview(log)

    site_names = _select_sites(log, sites)
    interval_s = _check_interval(log, from_s, until_s)
    _check_joints(log, site_names, joints)
    columns = {site: _list_columns(log, site) for site in site_names}
    groups = []
    for name in names or DEFAULT_QUANTITIES:
        panels = _find_lines(log, columns, name)
        groups.append(_filter_joints(log, name, panels, joints))
    return _draw_groups(log, groups, site_names, interval_s)


def _select_sites(log: Log, sites: str | Iterable[str] | None) -> list[str]:
    """Returns the sites that a user selected for a figure, in scenario order.

    Args:
        log: The log.
        sites: Name or names of the sites. `None` selects all.

    Raises:
        UnknownName: A site does not exist.
        UsageError: No site is selected.
    """
    if sites is None:
        return list(log.sites)
    selected = [sites] if isinstance(sites, str) else list(sites)
    if not selected:
        raise UsageError(f"sites is empty; the sites are {', '.join(log.sites)}")
    for site in selected:
        log[site]  # raises if there is no such site
    return [site for site in log.sites if site in selected]


def _check_interval(
    log: Log, from_s: float | None, until_s: float | None
) -> tuple[float, float]:
    """Validates the time interval that a user selected for a figure.

    Args:
        log: The log.
        from_s: Start, in s. `None` for the start of the log.
        until_s: End, in s. `None` for the end of the log.

    Returns:
        The start and end of the interval, in s.

    Raises:
        UsageError: The interval is empty or contains no records.
    """
    end_s = Timeline(log).end_s
    first_s = 0.0 if from_s is None else float(from_s)
    last_s = end_s if until_s is None else float(until_s)
    if not first_s < last_s:
        raise UsageError(
            f"from_s must be less than until_s, but from_s is {first_s:g} and until_s "
            f"{last_s:g}; the log ends at {end_s:g} s"
        )
    if first_s >= end_s or last_s <= 0.0:
        raise UsageError(
            f"there are no records from {first_s:g} s until {last_s:g} s; the log has records "
            f"from 0 s until {end_s:g} s"
        )
    return first_s, last_s


def _list_columns(log: Log, site: str) -> list[Column]:
    """Returns everything that can be plotted for a site: its record columns and its error.

    The error e is the deviation from the reference that the control law acts on. It is not
    stored in the log, and therefore not a column of its table.
    """
    columns = [*log.table(site).columns]
    arm = log.scenario.arms[site]
    if arm.shares_pose:
        # Arms with different joints follow each other by the pose of their end effectors.
        axes = TASK_AXES[: arm.counts.shared]
        units = ["m" if axis in "xyz" else "rad" for axis in axes]
        stems = [f"e_{axis}" for axis in axes]
    else:
        units = arm.joint_units("rad")
        stems = [f"e{number}" for number in range(1, len(units) + 1)]

    # The names have the form of the other columns: a stem and a unit, such as "e1_rad".
    errors = log[site].e
    for index, (stem, unit) in enumerate(zip(stems, units, strict=True)):
        column = Column(
            name=f"{stem}_{unit}",
            values=errors[:, index],
            unit=unit,
            meaning="error that the control law acts on",
            source=f"e[{index}]",
        )
        columns.append(column)
    return columns


def _get_quantity(column: Column) -> str:
    """Returns the name of the quantity to which a column belongs, such as "q" for "q1_rad".

    For a column that is a quantity of its own, this is the column name without the unit.
    """
    for start, quantity in _QUANTITIES_BY_SOURCE.items():
        if column.source.startswith(start):
            return quantity
    field, bracket, _ = column.source.partition("[")
    return field if bracket else column.stem


def _find_lines(log: Log, columns: Mapping[str, Sequence[Column]], name: str) -> _Panels:
    """Returns the lines selected by a name: one for each matching column of each site.

    A name may select several columns, for example all joint angles.

    Args:
        log: The log.
        columns: All columns, by site.
        name: Name of a quantity or of a column, with or without its unit, such as "q", "q1" or
            "q1_rad".

    Returns:
        Mapping from column name to the lines of its panel.

    Raises:
        UnknownName: The name selects no column.
    """
    panels: _Panels = {}
    for site, site_columns in columns.items():
        for column in site_columns:
            accepted_names = (column.name, column.stem, _get_quantity(column))
            if name in accepted_names:
                line = _Line(site, log[site].tick, log[site].t_s, column)
                panels.setdefault(column.name, []).append(line)
    if not panels:
        raise UnknownName(_explain_unknown_name(columns, name))
    return panels


def _explain_unknown_name(columns: Mapping[str, Sequence[Column]], name: str) -> str:
    """Returns the error message for an unknown column, which suggests a similar name.

    The user has probably misspelled the name.
    """
    if name in FIGURES:
        return (
            f"{name!r} is a figure and not a column of the log; "
            f"trilat_net.figure(log, {name!r}) draws it"
        )

    # Dictionaries remove duplicates and keep the order of the columns.
    quantities: dict[str, None] = {}
    column_names: dict[str, None] = {}
    for site_columns in columns.values():
        for column in site_columns:
            quantities[_get_quantity(column)] = None
            column_names[column.name] = None

    hint = suggest_nearest(name, [*quantities, *column_names])
    return (
        f"there is no column {name!r}{hint}; the quantities are {', '.join(quantities)}, and "
        f"the columns of a quantity have names such as {next(iter(column_names))}"
    )


def _number_joints(log: Log, site: str, joints: Joints) -> list[int]:
    """Returns the numbers, starting from 1, of the selected joints of a site's arm.

    A selection is a joint number or name, or several of them. Joints that the arm does not have
    are ignored.

    Args:
        log: The log.
        site: Name of the site.
        joints: The selected joints. `None` for all joints.
    """
    names = log.scenario.arms[site].joint_names
    numbers = list(range(1, len(names) + 1))
    if joints is None:
        return numbers

    selected = [joints] if isinstance(joints, int | str) else list(joints)
    return [
        number
        for number, name in zip(numbers, names, strict=True)
        if number in selected or name in selected
    ]


def _check_joints(log: Log, sites: Sequence[str], joints: Joints) -> None:
    """Raises UnknownName if a selected joint does not exist in any of the selected arms.

    Args:
        log: The log.
        sites: Names of the selected sites.
        joints: The selected joints.

    Raises:
        UnknownName: A joint does not exist.
    """
    if joints is None:
        return

    selected = [joints] if isinstance(joints, int | str) else list(joints)
    if not selected:
        raise UsageError("joints is empty; joints are numbers from 1 or names")

    for joint in selected:
        if not any(_number_joints(log, site, joint) for site in sites):
            names = log.scenario.arms[sites[0]].joint_names
            raise UnknownName(
                f"there is no joint {joint!r}; the joints of {sites[0]} are 1 to {len(names)}, "
                f"or {', '.join(names)}"
            )


def _filter_joints(log: Log, name: str, panels: _Panels, joints: Joints) -> _Panels:
    """Removes the columns of joints that the user did not select for the figure.

    Columns that do not belong to a joint, such as the age of a sample, are kept.

    Args:
        log: The log.
        name: Name that selected the columns, for the error message.
        panels: Mapping from column name to lines.
        joints: The selected joints.

    Raises:
        UsageError: No column is left.
    """
    if joints is None:
        return panels

    panels_of_joints: _Panels = {}
    for column_name, lines in panels.items():
        lines_of_joints = []
        for line in lines:
            joint_number = _get_joint_number(line.column)
            has_no_joint = joint_number is None
            if has_no_joint or joint_number in _number_joints(log, line.site, joints):
                lines_of_joints.append(line)
        if lines_of_joints:
            panels_of_joints[column_name] = lines_of_joints

    if not panels_of_joints:
        raise UsageError(f"{name} has no column of the joints {joints!r}")
    return panels_of_joints


def _get_joint_number(column: Column) -> int | None:
    """Returns the number of the joint to which a column belongs, or `None` if there is none."""
    quantity = _get_quantity(column)
    if quantity not in _JOINT_QUANTITIES:
        return None
    digits = re.match(r"\d+", column.name.removeprefix(quantity))
    return int(digits.group()) if digits else None


def _draw_groups(
    log: Log,
    groups: Sequence[_Panels],
    sites: Sequence[str],
    interval_s: tuple[float, float],
) -> Figure:
    """Draws groups of panels below each other in one figure, starting each group in a new row.

    Args:
        log: The log.
        groups: For each group, a mapping from column name to lines.
        sites: Names of all selected sites.
        interval_s: Start and end of the time axis, in s.
    """
    largest_group = max(len(group) for group in groups)
    column_count = 1
    if largest_group > 1:
        first_row = style.arrange_joints(largest_group, narrow=False)[0]
        column_count = len(first_row)

    # Each cell of the grid contains the name of a column, or an empty text after the end of a
    # group.
    cells: list[str] = []
    for group in groups:
        cells += group
        cells += [""] * (-len(cells) % column_count)
    row_count = len(cells) // column_count
    height_in = _MARGIN_IN + _ROW_IN * row_count

    lines: dict[str, list[_Line]] = {}
    for group in groups:
        lines.update(group)

    with style.time_figure(log, REPORT_SIZE, height_in, interval_s) as plot:
        grid = style.add_panels(plot.figure, row_count, column_count, sharex=True)
        # The lowest panel of each column, which has the time axis. Rows below may be empty.
        lowest: dict[int, Axes] = {}
        for index, name in enumerate(cells):
            row, column = divmod(index, column_count)
            axes: Axes = grid[row, column]
            if name:
                _draw_panel(plot, axes, lines[name], interval_s)
                lowest[column] = axes
            else:
                axes.remove()

        for axes in lowest.values():
            axes.tick_params(labelbottom=True)

        drawn_sites: set[str] = set()
        for panel_lines in lines.values():
            drawn_sites |= {line.site for line in panel_lines}
        entries = [site for site in sites if site in drawn_sites]
        plot.finish(list(lowest.values()), style.site_legend_entries(log, entries))
    return plot.figure


def _draw_panel(
    plot: style.TimeFigure,
    axes: Axes,
    lines: Sequence[_Line],
    interval_s: tuple[float, float],
) -> None:
    """Draws a column of several sites in one panel, so that they can be compared.

    Args:
        plot: The figure.
        axes: The panel.
        lines: The lines.
        interval_s: Start and end of the time axis, in s.
    """
    first_s, last_s = interval_s
    column = lines[0].column
    unit = f" ({style.typeset_unit(column.unit)})" if column.unit else ""
    axes.set_title(f"{column.stem}{unit}")
    category_names = _list_words(lines)

    # A column of texts, such as the mode, is a step curve between named values.
    for line in lines:
        options = style.site_line(plot.log, line.site)
        if category_names:
            options["drawstyle"] = "steps-post"
        visible = (line.t_s >= first_s) & (line.t_s <= last_s)
        values = _read_numbers(line.column, category_names)
        style.plot_decimated(
            axes, line.tick[visible], line.t_s[visible], values[visible], **options
        )
    if category_names:
        axes.set_yticks(range(len(category_names)), category_names)
    plot.mark(axes, [line.site for line in lines])
    style.flatten_rounding(axes)


def _list_words(lines: Sequence[_Line]) -> list[str]:
    """Returns the distinct strings in a string column, which label the value axis.

    The list is empty for a numerical column. The modes of the control loop are sorted by the
    numbers that represent them in messages for viewers. Other strings follow in alphabetical
    order.
    """
    words: set[str] = set()
    for line in lines:
        if line.column.is_text:
            words |= {str(word) for word in line.column.values}

    def sort_key(word: str) -> tuple[float, str]:
        behind_modes = len(NUMBERS_BY_MODE_WORD) + 1
        return NUMBERS_BY_MODE_WORD.get(word, behind_modes), word

    return sorted(words, key=sort_key)


def _read_numbers(column: Column, words: Sequence[str]) -> NDArray[np.float64]:
    """Returns the values of a column as numbers to plot, shape (K,). NaN marks a missing value.

    Strings, such as the mode of an arm, are replaced with their index in a list of all strings.

    Args:
        column: The column.
        words: The distinct strings in the column, each of which is drawn at its index. Empty
            for a numerical column.
    """
    if not words:
        return np.asarray(column.numbers(), dtype=np.float64)
    indices = {word: index for index, word in enumerate(words)}
    numbers = [indices[str(word)] for word in column.values]
    return np.array(numbers, dtype=np.float64)
