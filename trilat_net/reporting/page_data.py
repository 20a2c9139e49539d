"""Types of the data that the scripts of a report's page, `report.js` and `arms.js`, read.

The page holds one `PageData` as JSON. Long columns of numbers are encoded as base64. The tests
of pages in browsers (`tests/page/whole_pages.py`) report every field that a script reads and
that was not sent.

Invariant:
    - These types are the contract between the program and the scripts. A script reads no field
      that is not declared here.
    - Every field is sent, whether or not it has its default value. A script never has to guess
      the meaning of an absent field.
    - The field `kind` names the kind of a chart or an arm. A script never infers the kind from
      other fields.
"""

from typing import Any, Literal

import msgspec

Colour = int | Literal["limit"]
"""Index of a site in the palette of the page, or "limit".

The lines of references, true values and limits have the colour "limit".
"""


class ColumnTable(msgspec.Struct, frozen=True):
    """Columns of numbers over the ticks of a site.

    Attributes:
        rate_hz: rate of the ticks.
        tick: the ticks, as base64 of little-endian int32.
        columns: the columns, each as base64 of little-endian float32; NaN for a missing value.
    """

    rate_hz: int
    tick: str
    columns: list[str]


class TableSeries(msgspec.Struct, frozen=True, kw_only=True):
    """A line of a chart over time, which draws a column of a table.

    Attributes:
        label: name of the line.
        colour: colour of the line.
        table: index of the table in `PageData.tables`.
        column: index of the column in the table.
        dash: true for a dashed line.
    """

    label: str
    colour: Colour
    table: int
    column: int
    dash: bool = False


class HistogramSeries(msgspec.Struct, frozen=True):
    """A line of a histogram.

    Attributes:
        label: name of the line.
        colour: colour of the line.
        counts: the number of ticks in each bin.
    """

    label: str
    colour: Colour
    counts: list[int]


class DistributionSeries(msgspec.Struct, frozen=True):
    """A line of a cumulative distribution.

    Attributes:
        label: name of the line.
        colour: colour of the line.
        dash: true for a dashed line.
        values: the percentages at the chart's `x`, as base64 of little-endian float32.
    """

    label: str
    colour: Colour
    dash: bool
    values: str


class StatedLine(msgspec.Struct, frozen=True, rename={"from_s": "from", "to_s": "to"}):
    """A horizontal dashed line at a stated value, such as a mean delay.

    Attributes:
        value: the value, in the unit of the chart.
        colour: colour of the line.
        from_s: start of the line, s; "from" in JSON.
        to_s: end of the line, s; "to" in JSON.
    """

    value: float
    colour: Colour
    from_s: float
    to_s: float


class TimeChart(msgspec.Struct, frozen=True, kw_only=True, tag="time", tag_field="kind"):
    """A chart over time.

    Attributes:
        section: key of the section in `report.toml`.
        title: title of the chart.
        unit: unit of the values.
        series: the lines of the chart.
        sites: sites whose modes and changes are marked in the chart.
        lines: horizontal lines at stated values.
        links: true if changes of links are also marked, and stated lines lie above the series.
        log: true for a logarithmic axis of values.
        zero: true if the axis of values begins at 0.
        margin: least space above the values, as a share of the largest value.
    """

    section: str
    title: str
    unit: str
    series: list[TableSeries]
    sites: list[str]
    lines: list[StatedLine] = []
    links: bool = False
    log: bool = False
    zero: bool = False
    margin: float = 0.0


class HistogramChart(
    msgspec.Struct, frozen=True, kw_only=True, tag="histogram", tag_field="kind"
):
    """Counts of ticks over bins of equal width on a logarithmic axis.

    Attributes:
        section: key of the section in `report.toml`.
        title: title of the chart.
        unit: unit of the edges.
        series: the lines of the chart.
        edges: edges of the B bins, B + 1 numbers.
        periods: periods of the sites' loops, in the unit of the edges.
    """

    section: str
    title: str
    unit: str
    series: list[HistogramSeries]
    edges: list[float]
    periods: list[float]


class DistributionChart(
    msgspec.Struct, frozen=True, kw_only=True, tag="distribution", tag_field="kind"
):
    """Cumulative distributions of samples or ticks, in percent.

    Attributes:
        section: key of the section in `report.toml`.
        title: title of the chart.
        unit: unit of `x`.
        series: the lines of the chart.
        x: the values on the horizontal axis, as base64 of little-endian float32.
        log: true if the horizontal axis is logarithmic.
    """

    section: str
    title: str
    unit: str
    series: list[DistributionSeries]
    x: str
    log: bool


Chart = TimeChart | HistogramChart | DistributionChart


class PlanarArm(msgspec.Struct, frozen=True, kw_only=True, tag="planar", tag_field="kind"):
    """An arm of two links in the picture of the arms.

    Attributes:
        site: name of the site.
        colour: index of the site.
        table: index of the table with the actual and the desired angles of both joints, rad,
            and with the edges of the bodies.
        bodies: number of bodies of the site's plant.
        links_m: lengths of the links, m.
    """

    site: str
    colour: int
    table: int
    bodies: int
    links_m: list[float]


class ChainArm(msgspec.Struct, frozen=True, kw_only=True, tag="chain", tag_field="kind"):
    """A chain in the picture of the arms.

    Attributes:
        site: name of the site.
        colour: index of the site.
        table: index of the table with the coordinates, in the picture, of the points of the
            actual arm, of the reference and of the shadow, and of the edges of the bodies.
        bodies: number of bodies of the site's plant.
        points: number of points: the joints without the base, and the end effector.
    """

    site: str
    colour: int
    table: int
    bodies: int
    points: int


class MarkedChange(msgspec.Struct, frozen=True):
    """A change during the run.

    Attributes:
        n: number in the table of changes.
        t: time from which the change applies, s.
        site: site that applies the change.
        link: the changed link; "" for a change of another kind.
    """

    n: int
    t: float
    site: str
    link: str


class ModeSpan(msgspec.Struct, frozen=True, array_like=True):
    """An interval in which a site does not follow its peers; sent as a list.

    Attributes:
        colour: index of the site.
        mode: mode of the site.
        from_s: start of the interval, s.
        to_s: end of the interval, s.
    """

    colour: int
    mode: str
    from_s: float
    to_s: float


class Palettes(msgspec.Struct, frozen=True):
    """Colours of the sites in the notation of CSS.

    Attributes:
        light: colours for light screens.
        dark: colours for dark screens.
    """

    light: list[str]
    dark: list[str]


class PageData(msgspec.Struct, frozen=True, kw_only=True):
    """The whole data of a page.

    Attributes:
        end_s: end of the time axis, s.
        colours: colours of the sites.
        tables: tables of numbers, to which charts and arms refer by index.
        charts: the charts, in the order of the page.
        changes: the changes during the run.
        spans: by site, the intervals in which the site does not follow its peers.
        arms: the arms of the sites that have records.
        bounds_m: left, right, bottom and top of the pictures of the arms, in the units of these
            pictures.
    """

    end_s: float
    colours: Palettes
    tables: list[ColumnTable]
    charts: list[Chart]
    changes: list[MarkedChange]
    spans: dict[str, list[ModeSpan]]
    arms: list[PlanarArm | ChainArm]
    bounds_m: list[float]

    def to_builtins(self) -> dict[str, Any]:
        """Returns the data as dictionaries, lists and plain values for JSON."""
        plain: dict[str, Any] = msgspec.to_builtins(self)
        return plain
