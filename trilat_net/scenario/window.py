"""What a stretch of a run is expected to show: a table [[expect.windows]].

Law: a key names a quantity and its unit, its value is the least and the most that still hold; a key that is
absent asks nothing.
"""

from collections.abc import Iterator, Sequence
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from .tables import fields, known, nearest

Instant = Annotated[float, Meta(ge=0.0, le=86_400.0)]
Range = Annotated[tuple[Annotated[float, Meta(ge=-1e9, le=1e9)], ...], Meta(min_length=2, max_length=2)]

_WHERE = ("from_s", "to_s", "site")
OF_ALL = ("error_peak_rad", "speed_peak_rad_s", "torque_peak_nm")
"""Quantities that all sites together have."""


class Window(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, omit_defaults=True):
    """What must hold of the ticks from one time to another, as [least, most] of each quantity.

    A wall's force is that of the scenario's walls at the logged state, along their normals; of several it is
    the sum. Where a run ends before the window does, nothing of it is measured, and nothing holds.

    Attributes:
        from_s: nominal time of its first tick, s.
        to_s: its end, s; a tick at that time is no longer in it.
        site: of which site; left out: of all, which only the first three quantities allow.
        error_peak_rad: largest |e| of a joint.
        speed_peak_rad_s: largest speed of a joint.
        torque_peak_nm: largest control torque of a joint.
        q1_rad: angle of joint 1, at every tick.
        q2_rad: angle of joint 2, at every tick.
        push1_mean_nm: torque of operator and environment ON joint 1, the mean over the ticks.
        push2_mean_nm: the same of joint 2.
        wall_mean_n: force of the walls, the mean over the ticks, with or without contact.
        wall_deviation_n: its standard deviation over the ticks (of the population).
        wall_peak_n: the largest.
        wall_hits: how often it begins: ticks with force after one without, within the window.
    """

    from_s: Instant
    to_s: Instant
    site: str = ""
    error_peak_rad: Range | None = None
    speed_peak_rad_s: Range | None = None
    torque_peak_nm: Range | None = None
    q1_rad: Range | None = None
    q2_rad: Range | None = None
    push1_mean_nm: Range | None = None
    push2_mean_nm: Range | None = None
    wall_mean_n: Range | None = None
    wall_deviation_n: Range | None = None
    wall_peak_n: Range | None = None
    wall_hits: Range | None = None

    @property
    def asked(self) -> Iterator[tuple[str, tuple[float, ...]]]:
        """Yields what is asked: quantity, and its least and most."""
        for key in QUANTITIES:
            if (limits := getattr(self, key)) is not None:
                yield key, limits


QUANTITIES: tuple[str, ...] = tuple(key for key in fields(Window) if key not in _WHERE)
"""What can be asked of a window."""


def check_keys(written: Any) -> None:
    """Refuses keys that a window does not have, as its author wrote them.

    Args:
        written: the value of `windows`; what is no list of tables is refused later.

    Raises:
        ScenarioError: with the path of the key and the nearest valid one.
    """
    for n, table in enumerate(written if isinstance(written, list) else []):
        known(table, fields(Window), f"expect.windows[{n}]")


def fault(window: Window, sites: Sequence[str]) -> tuple[str, str] | None:
    """Returns what no run of a scenario could meet: (key, problem), or None; the key "" is the window itself.

    Args:
        window: what is expected.
        sites: names of the scenario's sites.
    """
    if window.to_s <= window.from_s:
        return "to_s", f"must be later than from_s = {window.from_s:g}, is {window.to_s:g}"
    if window.site and window.site not in sites:
        return (
            "site",
            f"no site {window.site!r}{nearest(window.site, sites)}; its sites are {', '.join(sites)}",
        )
    asked = dict(window.asked)
    if not asked:
        return "", f"asks nothing; it may ask {', '.join(QUANTITIES)}"
    for key, (least, most) in asked.items():
        if not window.site and key not in OF_ALL:
            return "site", f"is missing: {key} is of one site; its sites are {', '.join(sites)}"
        if least > most:
            return key, f"must be [least, most], is [{least:g}, {most:g}]"
    return None
