"""A picture of an episode at an instant, as an array of pixels: a panel per site, and the goal
of the task.

Invariant:
- The picture is a function of the poses, the goal and the time; its size never changes.
- The axes have fixed limits, so that motion in a film is motion of the arms.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ..analysis.arm_rows import joint_positions_m
from ..core.vectors import Array
from ..scenario import Scenario
from . import style
from .appearance import SITE_COLOURS
from .figures.arm_poses import project_arm_m, trace_bodies_m

PANEL_PX = 240
"""Side of a panel, pixels."""
_DPI = 100
_MARGIN = 1.08
"""Half the side of a panel, in reaches of the arm."""


class EpisodePicture:
    """The panels of the sites of a scenario, which are drawn anew for every picture.

    Args:
        scenario: the experiment.
        goal_site: the site in whose panel the goal of the task is drawn.
    """

    def __init__(self, scenario: Scenario, goal_site: str) -> None:
        self._scenario = scenario
        self._goal_site = goal_site
        names = scenario.names
        width_in = PANEL_PX * len(names) / _DPI
        self._figure = Figure(figsize=(width_in, PANEL_PX / _DPI), dpi=_DPI)
        self._canvas = FigureCanvasAgg(self._figure)
        self._panels = dict(
            zip(names, self._figure.subplots(1, len(names), squeeze=False)[0], strict=True)
        )
        self._figure.subplots_adjust(left=0.0, right=1.0, bottom=0.0, top=1.0, wspace=0.02)

    def draw(
        self,
        q_rad: Mapping[str, Array],
        bodies: Mapping[str, Mapping[str, Array]],
        goal_m: Array | None,
        title: str,
    ) -> NDArray[np.uint8]:
        """Returns the picture, shape (height, width, 3).

        Args:
            q_rad: joint angles by site, rad, shape (n,).
            bodies: poses of the bodies of plants, by site and name, shape (7,).
            goal_m: the place that the task asks for, m; None where the goal is no place of this
                arm.
            title: what stands in the corner of the first panel.
        """
        for number, (name, axes) in enumerate(self._panels.items()):
            arm = self._scenario.arms[name]
            points_m = joint_positions_m(arm, np.asarray(q_rad[name])[np.newaxis])[0]
            reach_m = _MARGIN * float(np.linalg.norm(np.diff(points_m, axis=0), axis=1).sum())
            drawn = project_arm_m(arm, points_m)
            colour = SITE_COLOURS[number % len(SITE_COLOURS)]
            axes.clear()
            axes.set(xlim=(-reach_m, reach_m), ylim=(-reach_m, reach_m), aspect="equal")
            axes.set_axis_off()
            poses = list(bodies.get(name, {}).values())
            if poses:
                sizes_m = self._scenario.bodies_m(name).values()
                for path in trace_bodies_m(arm, sizes_m, np.concatenate(poses)[np.newaxis]):
                    axes.plot(*path[0].T, color=style.REFERENCE, linewidth=0.8)
            axes.plot(*drawn.T, color=colour, linewidth=3.0, solid_capstyle="round")
            axes.plot(*drawn[1:].T, linestyle="none", marker="o", markersize=4.0, color=colour)
            axes.plot(
                0.0, 0.0, linestyle="none", marker="s", markersize=6.0, color=style.REFERENCE
            )
            if goal_m is not None and name == self._goal_site:
                place = project_arm_m(arm, np.asarray(goal_m))
                axes.plot(
                    *place, marker="x", markersize=9.0, markeredgewidth=2.0, color="#bb5566"
                )
            axes.text(0.03, 0.97, name, transform=axes.transAxes, va="top", fontsize=9.0)
        first = next(iter(self._panels.values()))
        first.text(0.03, 0.03, title, transform=first.transAxes, va="bottom", fontsize=8.0)
        self._canvas.draw()  # type: ignore[no-untyped-call]
        pixels: NDArray[np.uint8] = np.asarray(self._canvas.buffer_rgba())[:, :, :3].copy()  # type: ignore[no-untyped-call]
        return pixels


def is_position(goal: Sequence[float] | Array, end_effector_m: Array) -> bool:
    """Returns whether a goal has the numbers of a place of this end effector."""
    return np.shape(goal) == np.shape(end_effector_m)
