"""Registers functions that draw figures of a log, by name.

A module of this folder adds a figure by decorating a function:

    @draws("positions", "actual and desired angles", in_report=True)
    def draw_positions(log, form): ...

The figure is then available under this name in `trilat figure` and in the report.

Invariant:
    - Every name belongs to exactly one figure.
    - Figures are listed in the order in which they would appear in a paper, regardless of the
      order in which modules are imported.
"""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

from matplotlib.figure import Figure

from ...log import Log
from ..appearance import FigureSize

Draw = Callable[[Log, FigureSize], Figure]
"""Function that draws a figure of a log at a given size."""
Absent = Callable[[Log], str]
"""Function that returns the reason why the figure of a log would be empty, or an empty string.
"""
Drawing = TypeVar("Drawing", bound=Callable[..., Figure])
"""Type of a decorated function, which the decorator `draws` preserves."""


class FigureEntry(NamedTuple):
    """A kind of figure that can be drawn from any log, such as the joint angles over time.

    Attributes:
        about: Description of the contents, for lists of figures.
        draw: Function that draws the figure.
        absent: Function that returns the reason why the figure of a log would be empty, or an
            empty string if there is something to draw.
        in_report: True if the report of a run contains the figure.
    """

    about: str
    draw: Draw
    absent: Absent
    in_report: bool

    @staticmethod
    def list_all() -> dict[str, "FigureEntry"]:
        """Returns all registered figures by name, in the order in which a paper shows them.

        Figures without a place in this order, such as those in a newly added file, come last,
        in order of registration.
        """
        ranks = {name: rank for rank, name in enumerate(_PAPER_ORDER)}
        names = sorted(_ENTRIES, key=lambda name: ranks.get(name, len(ranks)))
        return {name: _ENTRIES[name] for name in names}


_ENTRIES: dict[str, FigureEntry] = {}
_PAPER_ORDER = (
    "overview", "operation", "operator_torques", "positions", "tracking_errors", "settling",
    "phase", "parameter_estimates", "control_torques", "hands_moved", "contact", "authority",
    "certificate", "observed_energy", "twins", "arms", "paths", "sample_age",
    "delay_distributions", "loop_timing",
)  # fmt: skip
"""Figure names in the order in which a paper shows them. Figures not listed here come last."""


def draws(
    name: str, about: str, absent: Absent = lambda _: "", *, in_report: bool = False
) -> Callable[[Drawing], Drawing]:
    """Registers the decorated function as a figure that can be drawn from a log.

    The function receives a log and the size of the figure, and returns a Matplotlib figure.

    Args:
        name: Name of the figure.
        about: Description of the contents.
        absent: Function that returns the reason why the figure of a log would be empty. By
            default, every log has something to draw.
        in_report: True if the report of a run contains the figure.

    Returns:
        The decorator.

    Raises:
        ValueError: Another figure has the same name.
    """

    def register(draw: Drawing) -> Drawing:
        """Registers a drawing function under its figure's name, and returns it unchanged."""
        other = _ENTRIES.get(name)
        if other is not None:
            modules = f"{other.draw.__module__} and {draw.__module__}"
            raise ValueError(f"figure {name} has two definitions, in {modules}")
        _ENTRIES[name] = FigureEntry(about, draw, absent, in_report)
        return draw

    return register


def unless(shows: Callable[[Log], object], reason: str) -> Absent:
    """Returns a function that explains why a figure cannot be drawn from a log.

    Pass it to the decorator `draws` as `absent`, so that figures without content are omitted.

    Args:
        shows: Function that returns a truthy value if a log has something to draw.
        reason: Explanation for all other logs.

    Returns:
        A function of a log that returns the explanation, or an empty string if the log has
        something to draw.
    """
    return lambda log: "" if shows(log) else reason
