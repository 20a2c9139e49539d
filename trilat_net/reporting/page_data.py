"""The data of a report's page, as its scripts `report.js` and `arms.js` read them.

Invariant:
- These types are the contract between the program and the scripts. A script reads no field that
  is not declared here.
- Every field is sent, whether or not it has its default value. A script never has to guess what
  an absent field means.
- The field `kind` names the kind of a chart or an arm. A script never infers the kind from
  other fields.

The tests of pages in browsers (`tests/page/whole_pages.py`) report every field that a script
reads and that was not sent.
"""

from typing import Any, Literal

import msgspec

Colour = int | Literal["limit"]
"""Index of a site in the palette of the page, or "limit" for references, true values and
limits.
"""


class ColumnTable(msgspec.Struct, frozen=True):
    """Columns of numbers over the ticks of one site.

    Attributes:
        rate_hz: rate of the ticks.
        tick: base64 of the ticks, little-endian int32.
        columns: base64 of each column, little-endian float32; NaN where there is no value.
    """

    rate_hz: int
    tick: str
    columns: list[str]


class TableSeries(msgspec.Struct, frozen=True, kw_only=True):
    """A line of a chart over time: a column of a table, both by their index."""

    label: str
    colour: Colour
    table: int
    column: int
    dash: bool = False


class HistogramSeries(msgspec.Struct, frozen=True):
    """A line of a histogram: how many ticks lie in each bin."""

    label: str
    colour: Colour
    counts: list[int]


class DistributionSeries(msgspec.Struct, frozen=True):
    """A line of a distribution: base64 of the percentages at the chart's `x`, little-endian
    float32.
    """

    label: str
    colour: Colour
    dash: bool
    values: str


class StatedLine(msgspec.Struct, frozen=True, rename={"from_s": "from", "to_s": "to"}):
    """A horizontal dashed line at a value that is stated, between two times, s."""

    value: float
    colour: Colour
    from_s: float
    to_s: float


class TimeChart(msgspec.Struct, frozen=True, kw_only=True, tag="time", tag_field="kind"):
    """A chart over time.

    Attributes:
        section: key of the section in `report.toml`.
        sites: sites whose modes and changes are marked in the chart.
        links: true if changes of links are marked as well, and if stated lines lie above the
            series.
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
        edges: edges of the bins, one more than there are counts.
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
    """Cumulative percentages.

    Attributes:
        x: base64 of the values on the axis, little-endian float32.
        log: true for a logarithmic axis of values.
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
        table: table of the actual and the desired angles of both joints, rad, and of the edges
            of the bodies.
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
        table: table of the coordinates of the actual, the desired and the shadow's points in
            the picture, and of the edges of the bodies.
        bodies: number of bodies of the site's plant.
        points: number of joints, with the end effector and without the base.
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
        t: time from which the change holds, s.
        site: site that takes the change in.
        link: link that is changed; "" for a change of another kind.
    """

    n: int
    t: float
    site: str
    link: str


class ModeSpan(msgspec.Struct, frozen=True, array_like=True):
    """A time in which a site does not follow its peers; sent as a list.

    Attributes:
        colour: index of the site.
        mode: mode of the site.
        from_s, to_s: beginning and end, s.
    """

    colour: int
    mode: str
    from_s: float
    to_s: float


class Palettes(msgspec.Struct, frozen=True):
    """Colours of the sites, as CSS has them, for the light and for the dark scheme."""

    light: list[str]
    dark: list[str]


class PageData(msgspec.Struct, frozen=True, kw_only=True):
    """All that the scripts of a report read.

    Attributes:
        end_s: end of the time axis, s.
        spans: per site, the times in which the site does not follow its peers.
        arms: arms of the sites that have a record.
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
        """Returns the data as dictionaries, lists and plain values, ready for JSON."""
        plain: dict[str, Any] = msgspec.to_builtins(self)
        return plain
