"""Registers the functions that draw figures of a log, each under a name.

    @draws("positions", "actual and desired angles (Fig. 4)", in_report=True)
    def draw_positions(log, form): ...

Invariant:
    - Every name has one figure.
    - Registered figures are listed in the order in which a paper has them.
"""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

from matplotlib.figure import Figure

from ...log.log_reader import Log
from ..appearance import FigureSize

Draw = Callable[[Log, FigureSize], Figure]
Absent = Callable[[Log], str]
Drawing = TypeVar("Drawing", bound=Callable[..., Figure])


class FigureEntry(NamedTuple):
    """A registered figure.

    Attributes:
        about: description of the contents.
        draw: function that draws the figure.
        absent: function that returns the reason why the figure of a log would be empty; "" if
            there is something to draw.
        in_report: True if the report has the figure.
    """

    about: str
    draw: Draw
    absent: Absent
    in_report: bool


_ENTRIES: dict[str, FigureEntry] = {}
_PAPER_ORDER = (
    "overview", "operation", "operator_torques", "positions", "tracking_errors", "settling",
    "phase", "parameter_estimates", "control_torques", "hands_moved", "contact", "authority",
    "certificate", "observed_energy", "twins", "arms", "paths", "sample_age",
    "delay_distributions", "loop_timing",
)  # fmt: skip
"""Names of figures in the order of a paper; other figures follow."""


def draws(
    name: str, about: str, absent: Absent = lambda _: "", *, in_report: bool = False
) -> Callable[[Drawing], Drawing]:
    """Returns a decorator that registers a function of a log and a size as a figure.

    Args:
        name: name of the figure.
        about: description of the contents.
        absent: function that returns the reason why the figure of a log would be empty.
        in_report: True if the report has the figure.

    Raises:
        ValueError: the figure is already registered.
    """

    def register(draw: Drawing) -> Drawing:
        other = _ENTRIES.get(name)
        if other is not None:
            modules = f"{other.draw.__module__} and {draw.__module__}"
            raise ValueError(f"figure {name} has two definitions, in {modules}")
        _ENTRIES[name] = FigureEntry(about, draw, absent, in_report)
        return draw

    return register


def unless(shows: Callable[[Log], object], reason: str) -> Absent:
    """Returns a function that explains why the figure of a log would be empty.

    Args:
        shows: function that returns a true value for a log with something to draw.
        reason: the explanation for other logs.
    """
    return lambda log: "" if shows(log) else reason


def list_figures() -> dict[str, FigureEntry]:
    """Returns all figures by name, in the order in which a paper has them."""
    ranks = {name: rank for rank, name in enumerate(_PAPER_ORDER)}
    names = sorted(_ENTRIES, key=lambda name: ranks.get(name, len(ranks)))
    return {name: _ENTRIES[name] for name in names}
