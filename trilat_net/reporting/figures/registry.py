"""Registry of all figures of a log, drawn by name for a paper or written beside the report.

    trilat_net.figure(log, "settling").savefig("settling.pdf")

Invariant: a figure is a function of a log and a figure size; equal logs give equal bytes.
"""

from collections.abc import Callable, Iterator, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from ...analysis.certificate.premises import check_scenario_premises
from ...analysis.certificate.stability_certificate import certify
from ...analysis.site_signals import sites_with_operator
from ...errors import UsageError
from ...execution.virtual_comparison import simulate_without_operators
from ...files import make_folder, refuse_existing
from ...log.log_reader import Log
from ...log.mcap_reader import Progress
from .. import style
from ..figure_size import COLUMN_IN, FigureSize, make_print_size
from ..style import FIGURE_FORMATS, write_figure
from . import arm_poses, authority, contact_force, joint_motion, loop_timing, sample_age
from .arm_poses import draw_arms
from .certificate_energy import draw_functional
from .joint_motion import (
    draw_operator_displacement,
    draw_operator_torques,
    draw_parameter_estimates,
    draw_positions,
    draw_tracking_errors,
)
from .loop_timing import draw_loop_timing
from .sample_age import draw_delay_distributions, draw_sample_age, has_varying_delay

NO_ESTIMATE_CHANGE = "no estimate changed in this run"


class FigureEntry(NamedTuple):
    """A figure.

    Attributes:
        about: what it shows, in a few words.
        draw: makes it.
        absent: says why a log has nothing for it; "" where it has.
    """

    about: str
    draw: Callable[[Log, FigureSize], Figure]
    absent: Callable[[Log], str] = lambda _: ""


def _no_hands(log: Log) -> str:
    return "" if sites_with_operator(log) else joint_motion.NO_OPERATOR


def _no_script(log: Log) -> str:
    return "" if any(site.hands for site in log.scenario.sites.values()) else joint_motion.NO_OPERATOR


def _no_walls(log: Log) -> str:
    return "" if contact_force.sites_with_walls(log) else contact_force.NO_SITE_WITH_WALL


def _no_clock(log: Log) -> str:
    return "" if loop_timing.has_loop_times(log) else loop_timing.explain_missing_loop_times(log)


def _no_functional(log: Log) -> str:
    law = check_scenario_premises(log.scenario)[0]
    return "" if law.holds else law.text


def _nothing_learnt(log: Log) -> str:
    learnt = any(len(log[site]) and np.ptp(log[site].theta_hat, axis=0).any() for site in log.sites)
    return "" if learnt else NO_ESTIMATE_CHANGE


def _hands_moved(log: Log, form: FigureSize) -> Figure:
    return joint_motion.draw_operator_displacement(log, simulate_without_operators(log), form)


def _certificate(log: Log, form: FigureSize) -> Figure:
    return draw_functional(log, certify(log), form)


FIGURES = {
    "operation": FigureEntry("torque on the arms above their angles", joint_motion.draw_operation, _no_hands),
    "operator_torques": FigureEntry(
        "torque on the arms (Fig. 3)", joint_motion.draw_operator_torques, _no_hands
    ),
    "positions": FigureEntry("actual and desired angles (Fig. 4)", joint_motion.draw_positions),
    "tracking_errors": FigureEntry(
        "errors, and the largest one still to come (Fig. 5)", joint_motion.draw_tracking_errors
    ),
    "settling": FigureEntry("size of the errors on a log axis, settling times", joint_motion.draw_settling),
    "phase": FigureEntry("errors against their rates", joint_motion.draw_phase_portrait),
    "parameter_estimates": FigureEntry(
        "estimates and true values (Fig. 6)",
        lambda log, form: joint_motion.draw_parameter_estimates(log, None, form),
        _nothing_learnt,
    ),
    "control_torques": FigureEntry("torque of the controllers", joint_motion.draw_control_torques),
    "hands_moved": FigureEntry("the log minus the same run without hands", _hands_moved, _no_script),
    "contact": FigureEntry("force of the walls, and depth in them", contact_force.draw_contact, _no_walls),
    "authority": FigureEntry(
        "shares that change, and where the arms went",
        authority.draw_authority,
        lambda log: "" if authority.sites_with_changing_dominance(log) else authority.CONSTANT_DOMINANCE,
    ),
    "certificate": FigureEntry(
        "V, its parts, who changed it, the energy balance", _certificate, _no_functional
    ),
    "arms": FigureEntry("the arms at a few instants", lambda log, form: arm_poses.draw_arms(log, None, form)),
    "sample_age": FigureEntry("age of the samples in use, per link", sample_age.draw_sample_age),
    "delay_distributions": FigureEntry(
        "delays and ages, how often",
        sample_age.draw_delay_distributions,
        lambda log: "" if sample_age.has_varying_delay(log) else sample_age.NO_VARYING_DELAY,
    ),
    "loop_timing": FigureEntry(
        "lateness and computing time of the loops", loop_timing.draw_loop_timing, _no_clock
    ),
}
"""By name, in the order in which a paper has them."""


def figure(log: Log, name: str, width_in: float = COLUMN_IN) -> Figure:
    """Returns a figure of a log for a paper, type 8 pt.

    Args:
        log: the log.
        name: which one, of `PLATES`.
        width_in: 3.5 for one column, 7 for two, in.

    Raises:
        UsageError: there is no such figure or width, or the log has nothing to show in it.
    """
    return _drawn(log, name, make_print_size(width_in))


def list_drawable_figures(log: Log) -> list[str]:
    """Returns the names of the figures for which a log has something to show."""
    return [name for name, plate in FIGURES.items() if not plate.absent(log)]


def write_figures(
    log: Log,
    folder: Path,
    names: Sequence[str] = (),
    *,
    width_in: float = COLUMN_IN,
    formats: Sequence[str] = FIGURE_FORMATS[:2],
    force: bool = False,
    progress: Progress | None = None,
) -> list[Path]:
    """Writes figures of a log into a folder, and returns the paths.

    Args:
        log: the log.
        folder: where to; made if it does not exist.
        names: which ones; none: all for which the log has something to show.
        width_in: 3.5 or 7, in.
        formats: of `FORMATS`.
        force: whether files that exist are replaced.
        progress: told how many figures are drawn, and how many there are.

    Raises:
        UsageError: there is no such figure, width or format, the log has nothing to show in it, or a file
            exists.
    """
    form, wanted = make_print_size(width_in), list(dict.fromkeys(names)) or list_drawable_figures(log)
    kinds = list(dict.fromkeys(formats))
    for kind in kinds:
        if kind not in FIGURE_FORMATS:
            raise UsageError(f"a figure is written as {', '.join(FIGURE_FORMATS)}, not as {kind!r}")
    for name in wanted:
        _check(log, name)
    paths = {name: [folder / f"{name}.{kind}" for kind in kinds] for name in wanted}
    _prepare(folder, [path for each in paths.values() for path in each], force=force)
    for n, (name, each) in enumerate(paths.items()):
        if progress is not None:
            progress(n, len(paths))
        drawn = FIGURES[name].draw(log, form)
        for path in each:
            write_figure(drawn, path, form.dpi)
    return [path for each in paths.values() for path in each]


def _drawn(log: Log, name: str, form: FigureSize) -> Figure:
    _check(log, name)
    return FIGURES[name].draw(log, form)


def _check(log: Log, name: str) -> None:
    if name not in FIGURES:
        near = get_close_matches(name, FIGURES, 1)
        hint = f"did you mean {near[0]!r}?" if near else f"there are {', '.join(FIGURES)}"
        raise UsageError(f"no figure {name!r}; {hint}")
    if why := FIGURES[name].absent(log):
        raise UsageError(f"{name}: nothing to show: {why}")


def _prepare(folder: Path, paths: Sequence[Path], *, force: bool) -> None:
    for path in paths:
        refuse_existing(path, force=force)
    make_folder(folder)


MOST_REPORT_FIGURES = 9
"""As many as a log can have."""


def draw_report_figures(log: Log, twin: Log | None) -> Iterator[tuple[str, Figure]]:
    """Yields every figure with the name of its file, without suffix.

    Args:
        log: the log.
        twin: the same experiment with nobody at the arms, or None.
    """
    yield "operator_torques", draw_operator_torques(log)
    yield "positions", draw_positions(log)
    yield "tracking_errors", draw_tracking_errors(log)
    yield "parameter_estimates", draw_parameter_estimates(log)
    yield "hands_moved", draw_operator_displacement(log, twin)
    yield "arms", draw_arms(log)
    yield "sample_age", draw_sample_age(log)
    if has_varying_delay(log):
        yield "delay_distributions", draw_delay_distributions(log)
    yield "loop_timing", draw_loop_timing(log)


def write_report_figures(
    log: Log, folder: Path, twin: Log | None, progress: Progress | None = None
) -> list[Path]:
    """Writes every figure as PNG into a folder that exists, and returns the paths."""
    paths = []
    for n, (name, figure) in enumerate(draw_report_figures(log, twin)):
        if progress is not None:
            progress(n, MOST_REPORT_FIGURES)
        path = folder / f"{name}.png"
        figure.savefig(path, dpi=style.REPORT_DPI)
        paths.append(path)
    return paths
