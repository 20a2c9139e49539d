"""Poses of the arms at a few instants: base, joints and end effector; a figure of them, and SVG
for the page.

Invariant: forward kinematics are those of the core; the reference pose is dashed behind each
arm. A chain is seen along parallel lines from one fixed direction, with up where gravity does
not pull.
"""

from collections.abc import Iterable, Sequence
from html import escape
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ...analysis import site_signals
from ...analysis.arm_rows import joint_positions_m, upright_axes
from ...analysis.site_signals import reference_angles
from ...analysis.timeline import recorded_end_s
from ...core.vectors import Array
from ...log.log_reader import Log
from ...scenario.arms import ArmModel
from .. import style
from ..appearance import REPORT_SIZE, FigureSize
from .figure_entry import draws

INSTANTS = 6
_NARROW_INSTANTS = 3
_PATH_POINTS = 400
_AZIMUTH, _ELEVATION = np.deg2rad((-50.0, 22.0))
"""Direction from which chains are seen: about the vertical from the base's x axis on, and above
the floor.
"""
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
"""Left, right, bottom and top."""
_BOX_PATH = 0.5 * np.array(
    [
        [1 - 2 * (n >> axis & 1) for axis in range(3)]
        for n in (0, 1, 3, 2, 0, 4, 5, 1, 5, 7, 3, 7, 6, 2, 6, 4)
    ]
)
"""Along all edges of a box of sides 1."""
_BASE: dict[str, Any] = {
    "linestyle": "none",
    "marker": "s",
    "markersize": 4.5,
    "color": style.REFERENCE,
}


class ArmPose(NamedTuple):
    """A site at an instant: its base, joints and end effector, (L, 2), and the path of the
    last, (P, 2), m.

    `shadow` is what a light straight above would cast onto a floor at the base: that of a
    chain, (L, 2), or nothing, (0, 2). `bodies` are those of its plant, see `trace_bodies_m`.
    """

    actual: Array
    desired: Array
    path: Array
    shadow: Array
    bodies: Sequence[Array] = ()


def trace_bodies_m(
    arm: ArmModel, sizes_m: Iterable[Sequence[float]], poses: Array
) -> list[Array]:
    """Returns the edges of the boxes of a plant's bodies as paths in the plane of a picture,
    (K, P, 2), m.

    Args:
        arm: of the site.
        sizes_m: of each body, along its own axes, m.
        poses: as records have them, shape (K, 7 b).
    """
    found = []
    for size, pose in zip(sizes_m, np.split(poses, poses.shape[1] // 7, axis=1), strict=True):
        w = pose[:, np.newaxis, 3:4]
        v = pose[:, np.newaxis, 4:]
        corners = np.broadcast_to(_BOX_PATH * np.asarray(size), (len(pose), *_BOX_PATH.shape))
        turned = corners + 2.0 * np.cross(v, np.cross(v, corners) + w * corners)
        edges = turned + pose[:, np.newaxis, :3]
        found.append(edges[..., :2] if arm.chain is None else project_arm_m(arm, edges))
    return found


def project_arm_m(arm: ArmModel, points: Array, *, onto_floor: bool = False) -> Array:
    """Returns points of an arm in the plane of a picture, shape (..., 2), m: a planar arm's are
    that already.

    `onto_floor`: those of their shadows.
    """
    if arm.chain is None:
        return points
    x, y, z = np.moveaxis(points @ upright_axes(arm.chain).T, -1, 0)
    across = y * np.cos(_AZIMUTH) - x * np.sin(_AZIMUTH)
    towards = x * np.cos(_AZIMUTH) + y * np.sin(_AZIMUTH)
    height = np.zeros_like(z) if onto_floor else z
    return np.stack(
        [across, height * np.cos(_ELEVATION) - towards * np.sin(_ELEVATION)], axis=-1
    )


def choose_instants_s(log: Log, count: int = INSTANTS) -> list[float]:
    """Returns instants to draw, first and last included, s: half by the clock, half by how much
    moves.

    Equal steps of time alone would spend most of a row on arms at rest.
    """
    end_s = recorded_end_s(log)
    grid = np.linspace(0.0, end_s, 1001)
    moved = np.zeros_like(grid)
    for name in log.sites:
        part = log[name]
        if len(part):
            step = np.abs(
                np.diff(site_signals.joint_angles(part), axis=0, prepend=part.q[:1])
            ).sum(axis=1)
            moved += np.interp(grid, part.t_s, np.cumsum(step))
    share = grid / end_s + (moved / moved[-1] if moved[-1] > 0.0 else 0.0)
    chosen = np.interp(np.linspace(0.0, share[-1], count), share, grid)
    step_s = 10.0 ** np.floor(np.log10(end_s / 50.0))
    inner = (float(np.round(t / step_s) * step_s) for t in chosen[1:-1])
    return sorted({0.0, *(round(t, 6) for t in inner if t < end_s), end_s})


def find_pose(log: Log, site: str, t_s: float) -> ArmPose | None:
    """Returns the pose of a site at an instant: that of its last record until then; None
    without one.
    """
    part = log[site]
    arm = log.scenario.arms[site]
    last = int(np.searchsorted(part.t_s, t_s + 1e-9, side="right")) - 1
    if last < 0:
        return None
    rows = np.unique(np.linspace(0, last, _PATH_POINTS).astype(np.int64))
    found = joint_positions_m(arm, part.q[rows])
    actual = project_arm_m(arm, found)
    desired = project_arm_m(
        arm, joint_positions_m(arm, reference_angles(part)[last : last + 1])[0]
    )
    shadow = project_arm_m(arm, found[-1 if arm.chain else len(found) :][:1], onto_floor=True)
    sizes_m = log.scenario.bodies_m(site).values()
    bodies = (
        [path[0] for path in trace_bodies_m(arm, sizes_m, part.bodies[last : last + 1])]
        if sizes_m
        else ()
    )
    return ArmPose(
        actual=actual[-1],
        desired=desired,
        path=actual[:, -1],
        shadow=shadow.reshape(-1, 2),
        bodies=bodies,
    )


def compute_pose_box_m(poses: Sequence[ArmPose | None]) -> PictureBox:
    """Returns left, right, bottom and top of a box around poses with a margin, m; the base is
    inside.
    """
    points = [np.concatenate([*one[:4], *one.bodies]) for one in poses if one is not None]
    every = np.concatenate([*points, np.zeros((1, 2))])
    low = every.min(axis=0)
    high = every.max(axis=0)
    centre = (low + high) / 2.0
    extent = max(float((high - low).max()), 0.1)
    half = np.maximum((high - low) / 2.0, 0.35 * extent) + 0.08 * extent
    (left, bottom) = centre - half
    (right, top) = centre + half
    return float(left), float(right), float(bottom), float(top)


@draws("arms", "the arms at a few instants", in_report=True)
def draw_arms(log: Log, form: FigureSize = REPORT_SIZE) -> Figure:
    """Returns the arms of all sites at a few instants: a row per site, a column per instant,
    axes in m.
    """
    times = choose_instants_s(log, _NARROW_INSTANTS if form.narrow else INSTANTS)
    drawn = {site: [find_pose(log, site, t) for t in times] for site in log.sites}
    planar = all(arm.chain is None for arm in log.scenario.arms.values())
    left, right, bottom, top = compute_pose_box_m([p for row in drawn.values() for p in row])
    side_in = (form.width_in - 0.6) / len(times)
    height_in = 0.75 + len(log.sites) * (side_in * (top - bottom) / (right - left) + 0.08)
    with style.styled_figure(form, height_in) as figure:
        grid = style.add_panels(figure, len(log.sites), len(times), sharex=True, sharey=True)
        for site, row in zip(log.sites, grid, strict=True):
            for axes, one in zip(row, drawn[site], strict=True):
                _arm(axes, one, style.site_colour(log, site))
            row[0].set_ylabel(f"{site}: y (m)" if planar else f"{site}: up (m)")
        for axes, t_s in zip(grid[0], times, strict=True):
            axes.set_title(f"t = {t_s:.4g} s")
        for axes in grid[-1]:
            axes.set_xlabel("x (m)" if planar else "across (m)")
        grid[0, 0].set(xlim=(left, right), ylim=(bottom, top))
        sites = [
            (style.site_title(log, s), {"color": style.site_colour(log, s), "linewidth": 2.0})
            for s in log.sites
        ]
        shadow = [] if planar else [("shadow", _SHADOW)]
        style.add_legend(figure, [*sites, ("desired", _DESIRED), ("base", _BASE), *shadow])
    return figure


def _arm(axes: Axes, drawn: ArmPose | None, colour: str) -> None:
    axes.set_aspect("equal")
    if drawn is None:
        style.annotate_empty_panel(axes, "no record")
        return
    if len(drawn.shadow):
        axes.plot(*drawn.shadow.T, **_SHADOW)
    for path in drawn.bodies:
        axes.plot(*path.T, color=style.REFERENCE, linewidth=0.8)
    axes.plot(*drawn.path.T, color=colour, linewidth=0.6, alpha=0.55)
    axes.plot(*drawn.desired.T, **_DESIRED)
    axes.plot(
        *drawn.actual.T,
        color=colour,
        linewidth=2.0,
        solid_capstyle="round",
        solid_joinstyle="round",
    )
    axes.plot(*drawn.actual[1:].T, linestyle="none", marker="o", markersize=2.6, color=colour)
    axes.plot(0.0, 0.0, **_BASE)


def render_arms_svg(log: Log, bounds_m: PictureBox, factor: float) -> str:
    """Returns HTML with a row per site that has a record, and a column per instant.

    Args:
        log: the log.
        bounds_m: left, right, bottom and top of every picture, m.
        factor: units of a picture per m.
    """
    left, right, bottom, top = (factor * bound for bound in bounds_m)
    times = choose_instants_s(log)
    cells = ["<span></span>", *(f'<span class="head">t = {t:.4g} s</span>' for t in times)]
    for index, site in enumerate(log.sites):
        if not len(log[site]):
            continue
        cells.append(f'<span class="head">{escape(site)}</span>')
        for t in times:
            drawn = find_pose(log, site, t)
            scaled = None
            if drawn is not None:
                bodies = [factor * path for path in drawn.bodies]
                scaled = ArmPose._make([*(factor * points for points in drawn[:4]), bodies])
            cells.append(
                _render_picture(
                    scaled, index, (left, right, bottom, top), f"{site} at {t:.4g} s"
                )
            )
    note = "Gray: the shadow on a floor at the base; up is where gravity does not pull."
    chains = any(arm.chain for arm in log.scenario.arms.values())
    columns = f"grid-template-columns: max-content repeat({len(times)}, 1fr)"
    return (
        f'<div class="strip" style="{columns}">{"".join(cells)}</div>'
        + f'<p class="note">{note}</p>' * chains
    )


def _render_picture(drawn: ArmPose | None, index: int, bounds: PictureBox, label: str) -> str:
    left, right, bottom, top = bounds
    box = f"{left:.3f} {-top:.3f} {right - left:.3f} {top - bottom:.3f}"
    ground = f'<line class="ground" x1="{left:.3f}" x2="{right:.3f}" y1="0" y2="0"/>'
    base = '<rect class="base" x="-.06" y="-.06" width=".12" height=".12"/>'
    inside = ""
    if drawn is not None:
        paths = [
            (f"path site-{index}", drawn.path),
            ("desired", drawn.desired),
            (f"arm site-{index}", drawn.actual),
            *(("body", path) for path in drawn.bodies),
        ]
        if len(drawn.shadow):
            ground = ""
            paths.insert(0, ("shadow", drawn.shadow))
        inside = "".join(
            f'<polyline class="{kind}" points="{_svg_points(path)}"/>' for kind, path in paths
        )
        inside += "".join(
            f'<circle class="fill-{index}" cx="{x:.3f}" cy="{-y:.3f}" r=".055"/>'
            for x, y in drawn.actual[1:]
        )
    return f'<svg viewBox="{box}" role="img" aria-label="{escape(label)}">{ground}{inside}{base}</svg>'


def _svg_points(xy: Array) -> str:
    """Returns points for SVG, whose y grows downwards, m."""
    return " ".join(f"{x:.3f},{-y:.3f}" for x, y in xy)
