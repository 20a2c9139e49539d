"""How a function becomes a figure of a log: its name, what is in it, and when there is nothing
to show.

    @draws("positions", "actual and desired angles (Fig. 4)", in_report=True)
    def draw_positions(log, form): ...

Invariant: whoever knows figures finds them here, in the order in which a paper has them.
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
    """A figure: what is in it, what draws it, and what returns why a log has nothing to show in
    it, or "".
    """

    about: str
    draw: Draw
    absent: Absent
    in_report: bool


_ENTRIES: dict[str, FigureEntry] = {}
_SHOWN = (
    "overview", "operation", "operator_torques", "positions", "tracking_errors", "settling", "phase",
    "parameter_estimates", "control_torques", "hands_moved", "contact", "authority", "certificate",
    "observed_energy", "twins", "arms", "paths", "sample_age", "delay_distributions", "loop_timing",
)  # fmt: skip
"""The order of a paper; others follow."""


def draws(
    name: str, about: str, absent: Absent = lambda _: "", *, in_report: bool = False
) -> Callable[[Drawing], Drawing]:
    """Declares that a function of a log and a figure size draws the figure of a name.

    Raises:
        ValueError: another function draws it.
    """

    def declare(draw: Drawing) -> Drawing:
        if other := _ENTRIES.get(name):
            homes = f"{other.draw.__module__} and {draw.__module__}"
            raise ValueError(f"figure {name} has two definitions, in {homes}")
        _ENTRIES[name] = FigureEntry(about, draw, absent, in_report)
        return draw

    return declare


def unless(shows: Callable[[Log], object], reason: str) -> Absent:
    """Returns what says the reason for which a log has nothing to show, unless `shows` is true
    of it.
    """
    return lambda log: "" if shows(log) else reason


def list_figures() -> dict[str, FigureEntry]:
    """Returns all figures by name, in the order in which a paper has them."""
    place = {name: n for n, name in enumerate(_SHOWN)}
    return dict(sorted(_ENTRIES.items(), key=lambda entry: place.get(entry[0], len(place))))
