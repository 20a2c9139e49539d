"""Draws the poses of the arms at a few moments of a run, for a figure and for a page.

A planar arm is drawn in its plane. An arm in space, called a chain, is drawn in parallel
projection from a fixed direction, with gravity pointing down.

The figure "arms" is drawn with Matplotlib, and `render_arms_svg` returns SVG for the page. Both
draw the same poses, which are computed by `find_pose`.

Invariant:
    - Joint positions come from the simulation kernel's forward kinematics.
    - The reference pose that the control law of each arm tries to reach is drawn with dashed
      lines.
"""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ...analysis import Timeline, build_arm_rows, site_signals
from ...core import Array
from ...log import Log
from .. import style
from ..appearance import REPORT_SIZE, FigureSize
from ..html_templates import render_macro
from ..plot_signals import reference_angles
from .figure_entry import draws

INSTANTS = 6
"""Number of moments at which the arms are drawn."""
_NARROW_INSTANTS = 3
"""Number of moments in a figure that is as wide as one column of a paper."""
_PATH_POINTS = 400
"""Maximum number of points on the path of an end effector."""
_AZIMUTH = np.deg2rad(-50.0)
"""Viewing direction for chains: angle about the vertical, from the x axis of the base, in rad.
"""
_ELEVATION = np.deg2rad(22.0)
"""Viewing direction for chains: angle above the floor, in rad."""
_SHADOW: dict[str, Any] = {
    "color": "#c9c9c9",
    "linewidth": 1.6,
    "solid_capstyle": "round",
    "zorder": 1.0,
}
_DESIRED: dict[str, Any] = {
    "color": style.REFERENCE,
    "linestyle": (0, (3, 1.5)),
    "linewidth": 0.8,
}
PictureBox = tuple[float, float, float, float]
"""Left, right, bottom and top of a picture."""
_CORNERS_ON_PATH = np.array([0, 1, 3, 2, 0, 4, 5, 1, 5, 7, 3, 7, 6, 2, 6, 4])
"""Corner numbers of a box along a path that visits all of its edges.

The bits of a number state on which side of the box the corner lies along x, y and z.
"""
_BOX_PATH = 0.5 - (_CORNERS_ON_PATH[:, np.newaxis] >> np.arange(3) & 1)
"""The path along the edges of a unit cube centred at the origin, shape (16, 3)."""
_BASE: dict[str, Any] = {
    "linestyle": "none",
    "marker": "s",
    "markersize": 4.5,
    "color": style.REFERENCE,
}


class _ArmPose(NamedTuple):
    """Pose of an arm at one moment, as points in the picture plane.

    Attributes:
        actual: Base, joints and end effector, in m, shape (L, 2).
        desired: The same points for the reference pose, in m, shape (L, 2).
        path: Path of the end effector from the start of the run, in m, shape (P, 2).
        shadow: Shadow of a chain on a floor at its base, with light from straight above, in m,
            shape (L, 2). Planar arms have no shadow: shape (0, 2).
        bodies: For each body that the arm can touch, its edges as a path, in m, shape (16, 2).
    """

    actual: Array
    desired: Array
    path: Array
    shadow: Array
    bodies: Sequence[Array] = ()

    def scale(self, factor: float) -> "_ArmPose":
        """Returns the pose with all points multiplied by a factor.

        This converts a pose from m to picture units.

        Args:
            factor: Picture units per m.
        """
        return _ArmPose(
            actual=factor * self.actual,
            desired=factor * self.desired,
            path=factor * self.path,
            shadow=factor * self.shadow,
            bodies=[factor * path for path in self.bodies],
        )

    def list_points(self) -> Array:
        """Returns all points drawn for this pose, from which the picture limits are computed.

        Returns:
            The points of the arm, of its reference pose, path and shadow, and of the bodies, in
            m, shape (K, 2).
        """
        parts = [self.actual, self.desired, self.path, self.shadow, *self.bodies]
        return np.concatenate(parts)


def trace_bodies_m(
    upright_axes: Array | None, sizes_m: Iterable[Sequence[float]], poses: Array
) -> list[Array]:
    """Returns the edges of box-shaped bodies as paths in the picture plane.

    A path visits all edges of a box, so that the box can be drawn as a single line.

    Args:
        upright_axes: See `project_arm_m`.
        sizes_m: Size of each of the b bodies along its own axes, in m.
        poses: Poses of the bodies in K records, shape (K, 7 b): for each body the position in
            m, followed by the orientation as a unit quaternion with w first.

    Returns:
        One path per body, in m, shape (K, 16, 2).
    """
    paths = []
    body_count = poses.shape[1] // 7
    for size, pose in zip(sizes_m, np.split(poses, body_count, axis=1), strict=True):
        position = pose[:, np.newaxis, :3]
        quaternion_w = pose[:, np.newaxis, 3:4]
        quaternion_v = pose[:, np.newaxis, 4:]
        box = _BOX_PATH * np.asarray(size)
        corners = np.broadcast_to(box, (len(pose), *box.shape))

        # Rotation of a point p by the quaternion (w, v): p + 2 v x (v x p + w p).
        inner = np.cross(quaternion_v, corners) + quaternion_w * corners
        rotated = corners + 2.0 * np.cross(quaternion_v, inner)
        edges = rotated + position
        if upright_axes is None:
            paths.append(edges[..., :2])  # a planar arm is drawn in its x-y plane
        else:
            paths.append(project_arm_m(upright_axes, edges))
    return paths


def project_arm_m(
    upright_axes: Array | None, points: Array, *, onto_floor: bool = False
) -> Array:
    """Projects points of an arm onto the picture plane, in m.

    A planar arm already lies in this plane. An arm in space is viewed from a fixed direction,
    with gravity pointing down.

    Args:
        upright_axes: Forward, sideways and up axes of an upright frame, expressed in the base
            frame, shape (3, 3). `None` for a planar arm.
        points: Points in the base frame, in m, shape (..., 3). Points of a planar arm have
            shape (..., 2) and are returned unchanged.
        onto_floor: True to return the shadows of the points on a floor at the base.

    Returns:
        Points in the picture, in m, shape (..., 2).
    """
    if upright_axes is None:
        return points

    upright_points = points @ upright_axes.T
    x, y, z = np.moveaxis(upright_points, -1, 0)
    # Rotate about the vertical axis by the azimuth, then tilt by the elevation of the viewer.
    across = y * np.cos(_AZIMUTH) - x * np.sin(_AZIMUTH)
    towards = x * np.cos(_AZIMUTH) + y * np.sin(_AZIMUTH)
    height = np.zeros_like(z) if onto_floor else z
    up = height * np.cos(_ELEVATION) - towards * np.sin(_ELEVATION)
    return np.stack([across, up], axis=-1)


def _choose_instants_s(log: Log, count: int = INSTANTS) -> list[float]:
    """Chooses the times at which to draw the arms, including the first and the last time.

    Equally spaced times would mostly show arms at rest. The times are instead equally spaced in
    a measure of progress that gives equal weight to elapsed time and to motion.

    Args:
        log: Log of the run.
        count: Maximum number of times. Fewer are returned if times coincide after rounding.

    Returns:
        The times in ascending order, in s.
    """
    end_s = Timeline(log).end_s
    grid_s = np.linspace(0.0, end_s, 1001)
    moved_rad = np.zeros_like(grid_s)
    for site in log.sites:
        records = log[site]
        if len(records):
            angles = site_signals.joint_angles(records)
            joint_steps = np.abs(np.diff(angles, axis=0, prepend=records.q[:1]))
            path_rad = np.cumsum(joint_steps.sum(axis=1))
            moved_rad += np.interp(grid_s, records.t_s, path_rad)

    progress = grid_s / end_s
    if moved_rad[-1] > 0.0:
        progress += moved_rad / moved_rad[-1]

    # Interpolating the times over the progress inverts it.
    chosen_progress = np.linspace(0.0, progress[-1], count)
    chosen_s = np.interp(chosen_progress, progress, grid_s)

    # The times are rounded to two or three digits, for short titles.
    step_s = 10.0 ** np.floor(np.log10(end_s / 50.0))
    times_s = {0.0, end_s}
    for time_s in chosen_s[1:-1]:
        rounded_s = float(np.round(time_s / step_s) * step_s)
        if rounded_s < end_s:
            times_s.add(round(rounded_s, 6))
    return sorted(times_s)


def find_pose(log: Log, site: str, t_s: float) -> _ArmPose | None:
    """Returns the pose of an arm at a given time, with the path of its end effector (tip).

    The pose is taken from the most recent record at or before that time.

    Args:
        log: Log of the run.
        site: Name of the site.
        t_s: The time, in s.

    Returns:
        The points to draw, in m. `None` if the site has no record up to this time.
    """
    records = log[site]
    arm = build_arm_rows(log.scenario, site)
    axes = arm.upright_axes
    until_s = t_s + 1e-9  # tolerates rounding errors of the time
    last = int(np.searchsorted(records.t_s, until_s, side="right")) - 1
    if last < 0:
        return None

    # Points of the path of the end effector. The last of them belongs to the last record.
    rows = np.unique(np.linspace(0, last, _PATH_POINTS).astype(np.int64))
    positions = arm.joint_positions_m(records.q[rows])
    actual = project_arm_m(axes, positions)

    reference = reference_angles(records)[last : last + 1]
    desired = project_arm_m(axes, arm.joint_positions_m(reference)[0])

    shadow: Array = np.zeros((0, 2))
    if axes is not None:
        shadow = project_arm_m(axes, positions[-1:], onto_floor=True)[0]

    bodies: list[Array] = []
    sizes_m = log.scenario.bodies_m(site).values()
    if sizes_m:
        paths = trace_bodies_m(axes, sizes_m, records.bodies[last : last + 1])
        bodies = [path[0] for path in paths]
    return _ArmPose(
        actual=actual[-1], desired=desired, path=actual[:, -1], shadow=shadow, bodies=bodies
    )


def compute_pose_box_m(poses: Sequence[_ArmPose | None]) -> PictureBox:
    """Returns a box around arm poses and their base, for use as the axis limits of a picture.

    Neither side of the box is shorter than 70 % of the other, so pictures are never narrow
    strips. A margin is added last.

    Args:
        poses: The poses. Entries that are `None` are ignored.

    Returns:
        Left, right, bottom and top of the box, in m.
    """
    points_of_poses = [pose.list_points() for pose in poses if pose is not None]
    base = np.zeros((1, 2))
    points = np.concatenate([*points_of_poses, base])
    low = points.min(axis=0)
    high = points.max(axis=0)
    centre = (low + high) / 2.0
    size = high - low
    longer_side_m = max(float(size.max()), 0.1)
    margin_m = 0.08 * longer_side_m
    half_size = np.maximum(size / 2.0, 0.35 * longer_side_m) + margin_m

    left, bottom = (centre - half_size).tolist()
    right, top = (centre + half_size).tolist()
    return left, right, bottom, top


@draws("arms", "the arms at a few instants", in_report=True)
def _draw_arms(log: Log, form: FigureSize = REPORT_SIZE) -> Figure:
    """Draws the poses of all arms at a few moments, one row per site and one column per moment.

    The figure shows at a glance how the arms moved, and how closely they followed each other.

    Args:
        log: Log of the run.
        form: Width, font sizes and resolution of the figure.
    """
    instants = _NARROW_INSTANTS if form.narrow else INSTANTS
    times_s = _choose_instants_s(log, instants)
    poses = {}
    for site in log.sites:
        poses[site] = [find_pose(log, site, t_s) for t_s in times_s]
    all_poses = [pose for row in poses.values() for pose in row]
    left_m, right_m, bottom_m, top_m = compute_pose_box_m(all_poses)
    is_planar = all(arm.chain is None for arm in log.scenario.arms.values())
    horizontal_name = "x" if is_planar else "across"
    vertical_name = "y" if is_planar else "up"

    # The height of a row follows from the width of a column, because both axes have one scale.
    axis_labels_in = 0.6
    column_in = (form.width_in - axis_labels_in) / len(times_s)
    row_in = column_in * (top_m - bottom_m) / (right_m - left_m) + 0.08
    with style.styled_figure(form, 0.75 + len(log.sites) * row_in) as figure:
        grid = style.add_panels(figure, len(log.sites), len(times_s), sharex=True, sharey=True)
        for site, row in zip(log.sites, grid, strict=True):
            for axes, pose in zip(row, poses[site], strict=True):
                _draw_pose(axes, pose, style.site_colour(log, site))
            row[0].set_ylabel(f"{site}: {vertical_name} (m)")

        for axes, t_s in zip(grid[0], times_s, strict=True):
            axes.set_title(f"t = {t_s:.4g} s")
        for axes in grid[-1]:
            axes.set_xlabel(f"{horizontal_name} (m)")
        grid[0, 0].set(xlim=(left_m, right_m), ylim=(bottom_m, top_m))

        entries: list[tuple[str, dict[str, Any]]] = []
        for site in log.sites:
            line = {"color": style.site_colour(log, site), "linewidth": 2.0}
            entries.append((style.site_title(log, site), line))
        entries += [("desired", _DESIRED), ("base", _BASE)]
        if not is_planar:
            entries.append(("shadow", _SHADOW))
        style.add_legend(figure, entries)
    return figure


def _draw_pose(axes: Axes, pose: _ArmPose | None, colour: str) -> None:
    """Draws a pose in a panel, or a note if `pose` is `None` because there is no record."""
    axes.set_aspect("equal")
    if pose is None:
        style.annotate_empty_panel(axes, "no record")
        return

    if len(pose.shadow):
        axes.plot(*pose.shadow.T, **_SHADOW)
    for path in pose.bodies:
        axes.plot(*path.T, color=style.REFERENCE, linewidth=0.8)

    axes.plot(*pose.path.T, color=colour, linewidth=0.6, alpha=0.55)
    axes.plot(*pose.desired.T, **_DESIRED)
    axes.plot(
        *pose.actual.T,
        color=colour,
        linewidth=2.0,
        solid_capstyle="round",
        solid_joinstyle="round",
    )

    joints = pose.actual[1:]
    axes.plot(*joints.T, linestyle="none", marker="o", markersize=2.6, color=colour)
    axes.plot(0.0, 0.0, **_BASE)


def render_arms_svg(log: Log, bounds_m: PictureBox, factor: float) -> Markup:
    """Draws the poses of all arms at a few moments as SVG pictures for the report's web page.

    There is one row per arm and one column per moment. Arms without records are omitted.

    Args:
        log: Log of the run.
        bounds_m: Left, right, bottom and top of every picture, in m.
        factor: Scale of the pictures, in picture units per m.

    Returns:
        HTML with the pictures.
    """
    left_m, right_m, bottom_m, top_m = bounds_m
    bounds = (factor * left_m, factor * right_m, factor * bottom_m, factor * top_m)

    times_s = _choose_instants_s(log)
    rows = []
    for index, site in enumerate(log.sites):
        if not len(log[site]):
            continue
        pictures = []
        for t_s in times_s:
            pose = find_pose(log, site, t_s)
            scaled = None if pose is None else pose.scale(factor)
            label = f"{site} at {t_s:.4g} s"
            pictures.append(_measure_picture(scaled, index, bounds, label))
        rows.append({"site": site, "pictures": pictures})

    return render_macro(
        "arms.html",
        "strip",
        times=[f"{t_s:.4g}" for t_s in times_s],
        rows=rows,
        has_shadows=any(arm.chain for arm in log.scenario.arms.values()),
    )


def _measure_picture(
    pose: _ArmPose | None, index: int, bounds: PictureBox, label: str
) -> dict[str, Any]:
    """Returns the coordinates needed by the SVG template of a pose: lines, joints, view box.

    The report page contains such a picture for each arm at a few moments.

    Args:
        pose: The pose in picture units. `None` for a picture without an arm.
        index: Index of the site, which determines its colour.
        bounds: Left, right, bottom and top of the picture.
        label: Description of the picture for screen readers.
    """
    left, right, bottom, top = bounds
    lines: list[tuple[str, Array]] = []
    joints: list[tuple[str, str]] = []
    has_shadow = False
    if pose is not None:
        has_shadow = len(pose.shadow) > 0
        if has_shadow:
            lines.append(("shadow", pose.shadow))
        lines += [
            (f"path site-{index}", pose.path),
            ("desired", pose.desired),
            (f"arm site-{index}", pose.actual),
        ]
        lines += [("body", path) for path in pose.bodies]
        # The y axis of SVG points downwards.
        joints = [(f"{x:.3f}", f"{-y:.3f}") for x, y in pose.actual[1:]]

    return {
        "box": f"{left:.3f} {-top:.3f} {right - left:.3f} {top - bottom:.3f}",
        "left": f"{left:.3f}",
        "right": f"{right:.3f}",
        "label": label,
        "index": index,
        "has_ground": not has_shadow,
        "paths": [(css_class, _format_points(path)) for css_class, path in lines],
        "joints": joints,
    }


def _format_points(points: Array) -> str:
    """Formats points, shape (K, 2), for SVG, whose y axis points downwards."""
    return " ".join(f"{x:.3f},{-y:.3f}" for x, y in points)
