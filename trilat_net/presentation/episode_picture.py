"""Draws the arms at one moment of an episode as a pixel array, for use in a video.

An episode is one attempt of a learned program at a task, see `trilat_studies`. The picture has
one panel per arm, and one of the panels also shows the goal of the task.

Invariant:
    - A picture depends only on the poses of the arms and bodies, the goal of the task, and the
      title.
    - All pictures of an episode have the same size and axis limits, so that only arms and
      bodies move in the video.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ..analysis import build_arm_rows
from ..core import Array
from ..scenario import Scenario
from . import style
from .appearance import SITE_COLOURS
from .figures.arm_poses import project_arm_m, trace_bodies_m

PANEL_PX = 240
"""Side length of a panel, in pixels."""
_DPI = 100
_MARGIN = 1.08
"""Half the side length of a panel, as a multiple of the reach of its arm."""
_GOAL: dict[str, Any] = {
    "marker": "x",
    "markersize": 9.0,
    "markeredgewidth": 2.0,
    "color": "#bb5566",
}
_BASE: dict[str, Any] = {
    "linestyle": "none",
    "marker": "s",
    "markersize": 6.0,
    "color": style.REFERENCE,
}


class EpisodePicture:
    """Draws successive pictures of the arms in a learning episode, reusing one figure.

    Args:
        scenario: Scenario of the task, with the arms.
        goal_site: Name of the site whose panel shows the goal of the task.
    """

    def __init__(self, scenario: Scenario, goal_site: str) -> None:
        self._scenario = scenario
        self._goal_site = goal_site
        names = scenario.names
        self._arms = {site: build_arm_rows(scenario, site) for site in names}
        side_in = PANEL_PX / _DPI
        width_in = PANEL_PX * len(names) / _DPI
        self._figure = Figure(figsize=(width_in, side_in), dpi=_DPI)
        self._canvas = FigureCanvasAgg(self._figure)
        panels = self._figure.subplots(1, len(names), squeeze=False)[0]
        self._panels: dict[str, Axes] = dict(zip(names, panels, strict=True))
        self._figure.subplots_adjust(left=0.0, right=1.0, bottom=0.0, top=1.0, wspace=0.02)

    def draw(
        self,
        q_rad: Mapping[str, Array],
        bodies: Mapping[str, Mapping[str, Array]],
        goal_m: Array | None,
        title: str,
    ) -> NDArray[np.uint8]:
        """Draws the arms, the bodies and the goal of the task at one moment of an episode.

        Args:
            q_rad: Joint angles of each site, in rad, shape (n,) each.
            bodies: For each site, the poses of the bodies that its arm can touch, keyed by body
                name, shape (7,) each.
            goal_m: Position required by the task, in m. `None` if the goal is not a position.
            title: Text in the lower left corner of the first panel.

        Returns:
            RGB pixels, shape (height, width, 3).
        """
        for number, (site, axes) in enumerate(self._panels.items()):
            arm = self._arms[site]
            colour = SITE_COLOURS[number % len(SITE_COLOURS)]
            q_rows_rad = np.asarray(q_rad[site])[np.newaxis]
            points_m = arm.joint_positions_m(q_rows_rad)[0]

            axes.clear()
            _scale_panel(axes, points_m)
            self._draw_bodies(axes, site, bodies.get(site, {}))
            _draw_arm(axes, project_arm_m(arm.upright_axes, points_m), colour)

            if goal_m is not None and site == self._goal_site:
                goal_in_picture = project_arm_m(arm.upright_axes, np.asarray(goal_m))
                axes.plot(*goal_in_picture, **_GOAL)
            axes.text(0.03, 0.97, site, transform=axes.transAxes, va="top", fontsize=9.0)

        first_panel = next(iter(self._panels.values()))
        first_panel.text(
            0.03, 0.03, title, transform=first_panel.transAxes, va="bottom", fontsize=8.0
        )
        return self._read_pixels()

    def _draw_bodies(self, axes: Axes, site: str, bodies: Mapping[str, Array]) -> None:
        """Draws the edges of the bodies, such as boxes, that an arm can touch.

        Args:
            axes: Panel of the figure, as Matplotlib axes.
            site: Name of the site.
            bodies: Mapping from body name to pose, shape (7,) each.
        """
        if not bodies:
            return
        poses = np.concatenate(list(bodies.values()))
        sizes_m = self._scenario.bodies_m(site).values()
        arm = self._arms[site]
        for path in trace_bodies_m(arm.upright_axes, sizes_m, poses[np.newaxis]):
            axes.plot(*path[0].T, color=style.REFERENCE, linewidth=0.8)

    def _read_pixels(self) -> NDArray[np.uint8]:
        """Returns the RGB pixels of the figure, without the alpha channel."""
        self._canvas.draw()  # type: ignore[no-untyped-call]
        rgba = np.asarray(self._canvas.buffer_rgba())  # type: ignore[no-untyped-call]
        pixels: NDArray[np.uint8] = rgba[:, :, :3].copy()
        return pixels


def _scale_panel(axes: Axes, points_m: Array) -> None:
    """Sets the axis limits of a panel so that the arm fits in every pose.

    The limits are based on the reach of the arm, which is the sum of its link lengths.

    Args:
        axes: Panel of the figure, as Matplotlib axes.
        points_m: Base, joints and end effector in any pose, in m, shape (L, 2) or (L, 3).
    """
    lengths_m = np.linalg.norm(np.diff(points_m, axis=0), axis=1)
    half_m = _MARGIN * float(lengths_m.sum())
    axes.set(xlim=(-half_m, half_m), ylim=(-half_m, half_m), aspect="equal")
    axes.set_axis_off()


def _draw_arm(axes: Axes, points_m: Array, colour: str) -> None:
    """Draws the links, joints and base of an arm in a panel.

    Args:
        axes: Panel of the figure, as Matplotlib axes.
        points_m: Base, joints and end effector in the picture, in m, shape (L, 2).
        colour: Colour of the arm.
    """
    axes.plot(*points_m.T, color=colour, linewidth=3.0, solid_capstyle="round")
    joints_m = points_m[1:]
    axes.plot(*joints_m.T, linestyle="none", marker="o", markersize=4.0, color=colour)
    axes.plot(0.0, 0.0, **_BASE)
