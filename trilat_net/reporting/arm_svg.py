"""Stick figures of the arms at a few instants as SVG, in the page's colours, light or dark.

Invariant: the poses are those of the figure `arms`.
"""

from html import escape

from ..core.vectors import Array
from ..log.log_reader import Log
from .figures.arm_poses import ArmPose, choose_instants_s, pose_at

_Box = tuple[float, float, float, float]


def render_arms_svg(log: Log, bounds_m: _Box, factor: float = 1.0) -> str:
    """Returns HTML with a row per site and a column per instant; bounds: left, right, bottom, top, m.

    A picture has `factor` units per m.
    """
    left, right, bottom, top = (factor * bound for bound in bounds_m)
    times = choose_instants_s(log)
    cells = ["<span></span>", *(f'<span class="head">t = {t:.4g} s</span>' for t in times)]
    for index, site in enumerate(log.sites):
        cells.append(f'<span class="head">{escape(site)}</span>')
        for t in times:
            drawn = pose_at(log, site, t)
            scaled = None if drawn is None else ArmPose(*(factor * points for points in drawn))
            cells.append(_picture(scaled, index, (left, right, bottom, top), f"{site} at {t:.4g} s"))
    columns = f"grid-template-columns: max-content repeat({len(times)}, 1fr)"
    return f'<div class="strip" style="{columns}">{"".join(cells)}</div>'


def _picture(drawn: ArmPose | None, index: int, bounds: _Box, label: str) -> str:
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
        ]
        if len(drawn.shadow):
            ground = ""
            paths.insert(0, ("shadow", drawn.shadow))
        inside = "".join(f'<polyline class="{kind}" points="{_points(path)}"/>' for kind, path in paths)
        inside += "".join(
            f'<circle class="fill-{index}" cx="{x:.3f}" cy="{-y:.3f}" r=".055"/>' for x, y in drawn.actual[1:]
        )
    return f'<svg viewBox="{box}" role="img" aria-label="{escape(label)}">{ground}{inside}{base}</svg>'


def _points(xy: Array) -> str:
    """Returns points for SVG, whose y grows downwards, m."""
    return " ".join(f"{x:.3f},{-y:.3f}" for x, y in xy)
