"""What a run of a scenario is expected to show: the table [expect], judged by `trilat test`.

Law: a key names a quantity, its limit and its unit, and its docstring defines the quantity exactly; a key
that is absent asks nothing. `..._max_...` is the largest value that still holds, `..._min_...` the smallest.
"""

from collections.abc import Sequence
from typing import Annotated

import msgspec
from msgspec import Meta

from . import window
from .window import Window

NotNegative = Annotated[float, Meta(ge=0.0, le=1e9)]
Positive = Annotated[float, Meta(gt=0.0, le=1e9)]
Pose = Annotated[tuple[Annotated[float, Meta(ge=-1e9, le=1e9)], ...], Meta(min_length=2, max_length=2)]

END_S = 1.0
"""The end of a run, where a key speaks of it: its last second."""


class Expect(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, omit_defaults=True):
    """What must hold of every run of a scenario, for every seed.

    The error of a site is e = q_i - q_id, Eq. (9); |e| is taken per joint. "Largest" and "smallest" are over
    all sites (or links), joints and ticks of the run. A run that diverged ends there: its figures are of the
    part before, and it fails unless `stable = false` is asked.

    Attributes:
        stable: true: no site diverges and the envelope of the largest |e| does not grow; false: one of the
            two happens. A run too short to tell fails both, see `analysis.envelope`.
        synchronised_by_s: from this time to the end of the run the largest |e| stays below
            `synchronised_rad`.
        synchronised_rad: what counts as synchronised, rad.
        peak_error_max_rad: largest |e| of the run.
        peak_error_min_rad: the same figure, from below: what must be seen to happen.
        rms_error_max_rad: root mean square of e over the run, of the worst joint of any site.
        end_error_max_rad: largest |e| of the last second.
        end_error_min_rad: the same figure, from below.
        end_spread_max_rad: largest difference between two sites' angles of one joint at one instant of the
            last second, undelayed; instants are the ticks of the first site.
        end_pose_rad: joint angles of a site's last tick, by the site's name, rad.
        end_pose_within_rad: how far each of those angles may be off, rad.
        peak_torque_max_nm: largest control torque of a joint.
        peak_speed_max_rad_s: largest speed of a joint.
        age_max_ms: largest age of the sample in use (now minus its stamp), from the first sample of a link
            on; a link that never had one fails.
        mean_age_max_ms: that age, averaged over a link's ticks; of the link where it is largest.
        mean_age_min_ms: the same average, of the link where it is smallest, from below.
        late_samples_max: samples of all links that came in too late to be used as their link meant them.
        no_gaps: true: there is a record of every tick, from 0 to the last that any site had to make; false
            asks nothing.
        windows: what stretches of the run must show, see `Window`.
    """

    stable: bool | None = None
    synchronised_by_s: NotNegative | None = None
    synchronised_rad: Positive = 0.01
    peak_error_max_rad: NotNegative | None = None
    peak_error_min_rad: NotNegative | None = None
    rms_error_max_rad: NotNegative | None = None
    end_error_max_rad: NotNegative | None = None
    end_error_min_rad: NotNegative | None = None
    end_spread_max_rad: NotNegative | None = None
    end_pose_rad: dict[str, Pose] = {}
    end_pose_within_rad: Positive = 0.01
    peak_torque_max_nm: NotNegative | None = None
    peak_speed_max_rad_s: NotNegative | None = None
    age_max_ms: NotNegative | None = None
    mean_age_max_ms: NotNegative | None = None
    mean_age_min_ms: NotNegative | None = None
    late_samples_max: Annotated[int, Meta(ge=0)] | None = None
    no_gaps: bool = False
    windows: tuple[Window, ...] = ()

    @property
    def asks(self) -> bool:
        """True where at least one key asks something; a tolerance alone does not."""
        tolerances = {"synchronised_rad": 0.01, "end_pose_within_rad": 0.01}
        return msgspec.structs.replace(self, **tolerances) != Expect()


def fault(expect: Expect, sites: Sequence[str]) -> tuple[str, str] | None:
    """Returns what no run of a scenario could meet: (key below `expect`, problem), or None.

    Args:
        expect: what is expected.
        sites: names of the scenario's sites.
    """
    for name in expect.end_pose_rad:
        if name not in sites:
            return f"end_pose_rad.{name}", f"no such site; its sites are {', '.join(sites)}"
    for n, one in enumerate(expect.windows):
        if found := window.fault(one, sites):
            return f"windows[{n}]{'.' * bool(found[0])}{found[0]}", found[1]
    for least, most in (
        ("peak_error_min_rad", "peak_error_max_rad"),
        ("end_error_min_rad", "end_error_max_rad"),
        ("mean_age_min_ms", "mean_age_max_ms"),
    ):
        low, high = getattr(expect, least), getattr(expect, most)
        if low is not None and high is not None and low > high:
            return least, f"must be at most {most} = {high:g}, is {low:g}"
    return None
