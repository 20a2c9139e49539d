"""Defines the data that the web page of a report contains for its scripts.

The scripts `report.js` and `arms.js` draw charts and moving arms in the browser. They read a
single `PageData` object as JSON, computed by `charts.ChartBuilder`. Long columns of numbers are
base64-encoded.

Invariant:
    - These types are the contract between the program and the scripts. Scripts read only fields
      declared here. The browser tests of the pages (`tests/page/whole_pages.py`) report every
      field that a script reads but that was not sent.
    - Every field is sent, even if it has its default value. Scripts never have to guess what an
      absent field means.
    - The field `kind` states the kind of a chart or an arm. Scripts never infer the kind from
      other fields.
"""

from typing import Any, Literal

import msgspec

Colour = int | Literal["limit"]
"""Index of a site in the palette of the page, or "limit".

Lines for references, true values and limits have the colour "limit".
"""


class TimeChart(msgspec.Struct, frozen=True, kw_only=True, tag="time", tag_field="kind"):
    """A chart that shows a quantity, such as joint angles, over time.

    Attributes:
        section: Key of the page section, as in `report.toml`.
        title: Title of the chart.
        unit: Unit of the values.
        series: Lines of the chart.
        sites: Names of the sites whose modes and changes are marked in the chart.
        lines: Horizontal lines at values specified by the scenario, such as a mean delay.
        links: True to also mark changes of links, and to draw the horizontal lines in front of
            the series.
        log: True for a logarithmic value axis.
        zero: True if the value axis starts at 0.
        margin: Minimum space above the values, as a fraction of the largest value.
        note: Sentences shown below the chart. Empty for none.
    """

    class Series(msgspec.Struct, frozen=True, kw_only=True):
        """A line of a chart over time, which plots one column of a `PageData.Table`.

        Several charts can share a table, so that the page contains its values only once.

        Attributes:
            label: Name of the line in the legend.
            colour: Colour of the line.
            table: Index of the table in `PageData.tables`.
            column: Index of the column in the table.
            dash: True for a dashed line.
        """

        label: str
        colour: Colour
        table: int
        column: int
        dash: bool = False

    class StatedLine(msgspec.Struct, frozen=True, rename={"from_s": "from", "to_s": "to"}):
        """Dashed horizontal line at a value specified by the scenario, such as the mean delay.

        Readers can compare it with the measured values.

        Attributes:
            value: The value, in the unit of the chart.
            colour: Colour of the line.
            from_s: Start of the line, in s. Called "from" in JSON.
            to_s: End of the line, in s. Called "to" in JSON.
        """

        value: float
        colour: Colour
        from_s: float
        to_s: float

    section: str
    title: str
    unit: str
    series: list[Series]
    sites: list[str]
    lines: list[StatedLine] = []
    links: bool = False
    log: bool = False
    zero: bool = False
    margin: float = 0.0
    note: str = ""


class HistogramChart(
    msgspec.Struct, frozen=True, kw_only=True, tag="histogram", tag_field="kind"
):
    """A histogram of a duration measured in every tick, such as the lateness of the tick.

    The bins have equal widths on a logarithmic axis.

    Attributes:
        section: Key of the page section, as in `report.toml`.
        title: Title of the chart.
        unit: Unit of the edges.
        series: Lines of the chart.
        edges: The B + 1 edges of the B bins.
        periods: Tick periods of the sites, in the unit of the edges. Drawn as limits.
    """

    class Series(msgspec.Struct, frozen=True):
        """One line of a histogram: the number of ticks of one site in each bin.

        All lines of a chart share its bins.

        Attributes:
            label: Name of the line in the legend.
            colour: Colour of the line.
            counts: Number of ticks in each bin.
        """

        label: str
        colour: Colour
        counts: list[int]

    section: str
    title: str
    unit: str
    series: list[Series]
    edges: list[float]
    periods: list[float]


class DistributionChart(
    msgspec.Struct, frozen=True, kw_only=True, tag="distribution", tag_field="kind"
):
    """A chart that shows cumulative distributions, for example of delays.

    Attributes:
        section: Key of the page section, as in `report.toml`.
        title: Title of the chart.
        unit: Unit of `x`.
        series: Lines of the chart.
        x: Values on the horizontal axis, as base64 of little-endian float32.
        log: True if the horizontal axis is logarithmic.
    """

    class Series(msgspec.Struct, frozen=True):
        """One line of a cumulative distribution: the percentage of values not exceeding each x.

        For example, 95 % of the delays are at most 20 ms.

        Attributes:
            label: Name of the line in the legend.
            colour: Colour of the line.
            dash: True for a dashed line.
            values: Percentages at the chart's `x`, as base64 of little-endian float32.
        """

        label: str
        colour: Colour
        dash: bool
        values: str

    section: str
    title: str
    unit: str
    series: list[Series]
    x: str
    log: bool


Chart = TimeChart | HistogramChart | DistributionChart


class PageData(msgspec.Struct, frozen=True, kw_only=True):
    """All data drawn by the scripts of a report's web page.

    Attributes:
        end_s: End of the time axis, in s.
        colours: Colours of the sites.
        tables: Numerical tables, to which the charts and arms refer by index.
        charts: Charts in page order.
        changes: Changes during the run.
        spans: For each site, the intervals in which it does not follow its peers.
        arms: Arms of the sites that have records.
        leads: Dominance factors of each slave whose factors change, in the order of the bars.
        bounds_m: Left, right, bottom and top of the pictures of the arms, in picture units.
    """

    class PlanarArm(msgspec.Struct, frozen=True, kw_only=True, tag="planar", tag_field="kind"):
        """Data for drawing an arm with two links that moves in a plane.

        Attributes:
            site: Name of the site.
            caption: Name and role of the site, such as "m1, master 1".
            colour: Index that selects the colour of the arm.
            table: Index of the table with the data to draw. Its columns are the actual and the
                desired angles of both joints, in rad, followed by the outlines of the bodies.
            bodies: Number of bodies that the arm can touch.
            links_m: Lengths of the links, in picture units.
        """

        site: str
        caption: str
        colour: int
        table: int
        bodies: int
        links_m: list[float]

    class ChainArm(msgspec.Struct, frozen=True, kw_only=True, tag="chain", tag_field="kind"):
        """Data for drawing an arm that moves in space, projected onto a plane.

        Attributes:
            site: Name of the site.
            caption: Name and role of the site, such as "m1, master 1".
            colour: Index that selects the colour of the arm.
            table: Index of the table with the coordinates to draw: the points of the actual
                arm, of the arm in the desired pose, and of the shadow on the floor, followed by
                the outlines of the bodies.
            bodies: Number of bodies that the arm can touch.
            points: Number of points of an arm: the joints, excluding the base, and the end
                effector.
        """

        site: str
        caption: str
        colour: int
        table: int
        bodies: int
        points: int

    class Table(msgspec.Struct, frozen=True):
        """Values of one arm over time, as stored in the report's web page.

        A table has one row per displayed tick. Each line of a chart plots one of its columns.

        Attributes:
            rate_hz: Tick rate of the site, used to convert ticks to times.
            tick: Ticks of the rows, as base64 of little-endian int32.
            columns: Values of each column, as base64 of little-endian float32. NaN marks a
                missing value.
        """

        rate_hz: int
        tick: str
        columns: list[str]

    class MarkedChange(msgspec.Struct, frozen=True):
        """A change during the run that is marked in charts, such as a new delay of a link.

        The number n links the mark to the table row that explains the change.

        Attributes:
            n: Number in the table of changes.
            t: Time from which the change applies, in s.
            site: Name of the site that applies the change.
            link: The changed link. Empty for other kinds of change.
        """

        n: int
        t: float
        site: str
        link: str

    class ModeSpan(msgspec.Struct, frozen=True, array_like=True):
        """An interval in which an arm did not follow the others, shaded in charts.

        It is sent to the page as a JSON list.

        Attributes:
            colour: Index of the site, which determines the colour.
            mode: Mode of the site.
            from_s: Start of the interval, in s.
            to_s: End of the interval, in s.
        """

        colour: int
        mode: str
        from_s: float
        to_s: float

    class Palettes(msgspec.Struct, frozen=True):
        """Colours of the arms for the light and the dark theme of the page.

        The colours are in scenario order, in CSS notation such as "#004488".

        Attributes:
            light: Colours for the light theme.
            dark: Colours for the dark theme.
        """

        light: list[str]
        dark: list[str]

    class LeadBar(msgspec.Struct, frozen=True, kw_only=True):
        """Data for a bar that shows which arms lead a slave arm over time.

        Dominance factors change linearly between two consecutive points in time.

        Attributes:
            site: Name of the slave.
            peers: Names of the peers.
            t: Times of the points, in s.
            shares: For each peer, its dominance factor at these times.
        """

        site: str
        peers: list[str]
        t: list[float]
        shares: list[list[float]]

    end_s: float
    colours: Palettes
    tables: list[Table]
    charts: list[Chart]
    changes: list[MarkedChange]
    spans: dict[str, list[ModeSpan]]
    arms: list[PlanarArm | ChainArm]
    leads: list[LeadBar]
    bounds_m: list[float]

    def to_builtins(self) -> dict[str, Any]:
        """Converts the data to lists and dictionaries, which the page stores as JSON."""
        plain: dict[str, Any] = msgspec.to_builtins(self)
        return plain
