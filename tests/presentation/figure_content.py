"""The content of a figure: its curves, and its words that are cut off or overlap."""

from itertools import combinations

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.text import Text
from matplotlib.transforms import Bbox

SLACK_PT = 1.0
"""The permitted overlap of boxes, which have room above small letters."""


def list_drawn_texts(figure: Figure) -> list[tuple[str, Bbox]]:
    """Returns every text that is drawn and its box, pt; numbers of an axis that lie outside the
    axis are not drawn.
    """
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    renderer = canvas.get_renderer()
    unseen = set()
    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            scale = axis.get_transform().transform
            low, high = sorted(scale(axis.get_view_interval()))
            room = 1e-6 * (high - low)
            for tick in (*axis.get_major_ticks(), *axis.get_minor_ticks()):
                if not low - room <= scale(tick.get_loc()) <= high + room:
                    unseen |= {tick.label1, tick.label2}
    texts = []
    for text in figure.findobj(Text):
        if text.get_visible() and text.get_text().strip() and text not in unseen:
            box = text.get_window_extent(renderer)
            if box.width and box.height:
                texts.append((text.get_text(), Bbox(box.get_points() * 72.0 / figure.dpi)))
    return texts


def list_curves(axes: Axes) -> list[Line2D]:
    """Returns the lines over time of a panel, without lines that span the panel or mark a change."""
    return [line for line in axes.lines if line.get_transform() == axes.transData]


def list_misplaced(figure: Figure) -> list[str]:
    """Returns words that are not wholly in the figure, and pairs of words that overlap."""
    width, height = figure.get_size_inches() * 72.0
    texts = list_drawn_texts(figure)
    cut_off = [
        f"{said!r} is cut off"
        for said, box in texts
        if box.x0 < -SLACK_PT
        or box.y0 < -SLACK_PT
        or box.x1 > width + SLACK_PT
        or box.y1 > height + SLACK_PT
    ]
    on_each_other = [
        f"{text!r} lies on {other!r}"
        for (text, a), (other, b) in combinations(texts, 2)
        if min(a.x1, b.x1) - max(a.x0, b.x0) > SLACK_PT
        and min(a.y1, b.y1) - max(a.y0, b.y0) > SLACK_PT
    ]
    return cut_off + on_each_other
