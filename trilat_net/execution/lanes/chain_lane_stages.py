"""Computes one control period of an arm of n joints, for several simulations at once.

`lane_stages` does the same for planar arms. The recursions from joint to joint are computed for
eight runs at a time, with `lane_vectors`. All other stages are loops over the runs, each of
which has its own lane (position in the vector registers).

Invariant:
    - No equation is repeated here. The functions and the order of the stages are those of
      `kernel`.
    - The frames of the joints of all lanes are up to date wherever a function of one lane needs
      them. Therefore `place_joints` does nothing in one lane.
"""

from collections.abc import Callable
from typing import Any

from ...core import (
    Array,
    IntArray,
    TorqueTable,
    adapts,
    add_task_torque,
    chain_stages,
    emit_stages,
    finish_advance,
    guard_reference,
    hold_motor_torque,
    lane_leaf,
    place_joints,
    set_lane_form,
    sum_trapezoid,
    update_peaks,
    update_pose,
    update_reference,
    update_sums,
    update_task_errors,
    updates_estimate,
)
from ...records import Mode
from .lane_rows import LaneRow, RowsInLane, in_lane
from .lane_vectors import GROUP, RowInGroup, in_group

_DIVERGED = int(Mode.DIVERGED)


def _place_nothing(_chain: Any, _q: Any) -> None:
    """Does nothing: the version of `place_joints` for a single run of several.

    The frames of the joints of all runs have been computed before, eight runs at a time.
    """


def _put_no_gravity(_s: Any, _chain: Any, _q: Any, _torque: Any) -> None:
    """Does nothing: the version of `put_gravity_torque` for a single run of several.

    The torques of all runs have been computed before, eight runs at a time.
    """


def _choose_place(argument_types: tuple[Any, ...]) -> Callable[..., None]:
    """Returns the version of `place_joints` for one run or for eight runs at once.

    The compiler calls this function with the types of the arguments.
    """
    dispatcher: Any = place_joints
    is_one_lane = isinstance(argument_types[0], RowsInLane)
    return _place_nothing if is_one_lane else dispatcher.py_func


def _choose_gravity(argument_types: tuple[Any, ...]) -> Callable[..., None]:
    """Returns the version of `put_gravity_torque` for one run or for eight runs at once.

    The compiler calls this function with the types of the arguments.
    """
    dispatcher: Any = chain_stages.put_gravity_torque
    is_one_lane = isinstance(argument_types[0], LaneRow)
    return _put_no_gravity if is_one_lane else dispatcher.py_func


def _skip_pose(_s: Any, _chain: Any) -> None:
    """Does nothing in place of `update_pose`: runs in task space are not computed together."""


def _skip_task_errors(_s: Any) -> None:
    """Does nothing in place of `update_task_errors`, which only runs in task space need."""


def _skip_task_torque(_s: Any, _gains: Any, _values: Any, _factor: float, _torque: Any) -> None:
    """Does nothing in place of `add_task_torque`, which only runs in task space need."""


def _skip_group(function: Any, skipped: Callable[..., None]) -> None:
    """Makes the compiler leave out a function when it compiles code for eight runs at once.

    Functions of task space are never called in such runs. But the compiler also compiles
    branches that are never taken, and it cannot compile these functions for eight runs.

    Args:
        function: The function, whose first argument is the state of a site (arm controller).
        skipped: A function with the same arguments that does nothing.
    """

    def choose_form(argument_types: tuple[Any, ...]) -> Callable[..., None]:
        is_group = isinstance(argument_types[0], RowInGroup)
        return skipped if is_group else function.py_func

    set_lane_form(function, choose_form)


_skip_group(update_pose, _skip_pose)
_skip_group(update_task_errors, _skip_task_errors)
_skip_group(add_task_torque, _skip_task_torque)
set_lane_form(place_joints, _choose_place)
set_lane_form(chain_stages.put_gravity_torque, _choose_gravity)


@lane_leaf
def advance_chain_site(
    k: int,
    t_ns: int,
    lanes: int,
    settled_rad: float,
    i: int,
    block_row: int,
    pages: int,
    bucket: int,
    record_row: int,
    site: Any,
    links: Any,
    actors: Any,
    environments: Any,
    ramps: Any,
    record: Any,
    peaks: Any,
    sums: Any,
    progress: Any,
    _scratch: Any,
    _law: Any,
    _received: Any,
    _sent: Any,
    _code: Any,
    chain: Any,
    states: Array,
    used: IntArray,
    _columns: IntArray,
    table: TorqueTable,
) -> None:
    """Computes one tick of a site for several runs, see `advance_site`.

    All tables have a lane for each run. No two of them overlap in memory.

    Args:
        k: The tick.
        t_ns: Its nominal time, ns since the epoch.
        lanes: Number of lanes to compute, at most `LANES`.
        settled_rad: Position error below which an arm counts as settled, rad.
        i: Index of the site.
        block_row: Row of the tick in `used`.
        pages: Number of latest states of each site in `states`, a power of two.
        bucket: Row of the tick in `peaks`.
        record_row: Row of the tick in `record`.
        site: Row of the site.
        links: Rows of its links.
        actors: Rows of its operators and environments.
        environments: The rows of its environments among them.
        ramps: Row with the changes of its dominance factors.
        record: Rows with the floats of its latest records; one is written.
        peaks: Peaks of the site, one row per bucket, see `update_peaks`.
        sums: Sums of the site.
        progress: Progress of the site.
        chain: Rows of the joints.
        states: The latest states of all sites, see `advance_site`.
        used: Sample in use by peer, lane and tick of a block; -1: none yet.
        table: Tables of the operators and environments of all sites, equal in all runs.
    """
    groups = (lanes + GROUP - 1) // GROUP

    # 2 release: the state of each peer that is in use
    for lane in range(lanes):
        rows = in_lane(links, lane)
        joints = in_lane(site, lane)[0].joints
        for p in range(rows.shape[0]):
            link = rows[p]
            sample = used[p, lane, block_row]
            # The peers of a site are all other sites, in scenario order.
            peer = p if p < i else p + 1
            page = pages if sample < 0 else sample & (pages - 1)
            link.used = sample
            for c in range(joints):
                link.q[c] = states[peer, page, lane, c]
                link.qd[c] = states[peer, page, lane, joints + c]
                link.tau_x[c] = states[peer, page, lane, 2 * joints + c]

    # 3 reference
    for lane in range(lanes):
        update_reference(
            t_ns,
            in_lane(site, lane)[0],
            in_lane(links, lane),
            in_lane(ramps, lane)[0].rows,
        )
    for group in range(groups):
        chain_stages.place_chain(in_group(site, group)[0], in_group(chain, group))
    for lane in range(lanes):
        guard_reference(k, t_ns, in_lane(site, lane)[0], in_lane(links, lane))

    # 4 errors, 5 estimate. A run of which an arm has left its limits has ended.
    for group in range(groups):
        group_site = in_group(site, group)[0]
        chain_stages.update_errors(group_site, in_group(chain, group))
        if updates_estimate(k, group_site):
            sum_trapezoid(group_site)
            half_s = 0.5 / group_site.rate_hz
            chain_stages.advance_estimate(group_site, half_s, group_site.Yr_before)
    t_s = t_ns * 1e-9
    for lane in range(lanes):
        chain_stages.update_external_torque(
            t_s=t_s,
            s=in_lane(site, lane)[0],
            chain=in_lane(chain, lane),
            actors=in_lane(actors, lane),
            table=table,
        )

    # 6 torque, 7 emit
    for group in range(groups):
        chain_stages.update_torque(in_group(site, group)[0], in_group(chain, group))
    for lane in range(lanes):
        s = in_lane(site, lane)[0]
        floats = in_lane(record, lane)[record_row].floats
        emit_stages(k=k, t_ns=t_ns, s=s, chain=in_lane(chain, lane), record=floats)
        joints = s.joints
        page = k & (pages - 1)
        for c in range(joints):
            states[i, page, lane, c] = floats[c]
            states[i, page, lane, joints + c] = floats[joints + c]
            states[i, page, lane, 2 * joints + c] = floats[5 * joints + c]

    # 8 advance
    h_s = 1.0 / in_lane(site, 0)[0].rate_hz
    half_s = 0.5 * h_s
    for lane in range(lanes):
        s = in_lane(site, lane)[0]
        if s.mode != _DIVERGED:
            hold_motor_torque(k, s)
    for group in range(groups):
        group_site = in_group(site, group)[0]
        chain_stages.begin_stages(group_site, group_site.joints)
    for stage in range(4):
        stage_t_s = t_s
        ahead_s = half_s
        weight = 1.0
        if stage > 0:
            stage_t_s = t_s + half_s
            weight = 2.0
        if stage == 2:
            ahead_s = h_s
        if stage == 3:
            stage_t_s = t_s + h_s
            ahead_s = 0.0
            weight = 1.0
        for group in range(groups):
            place_joints(in_group(chain, group), in_group(site, group)[0].stage_q)
        for lane in range(lanes):
            chain_stages.put_stage_torque(
                t_s=stage_t_s,
                s=in_lane(site, lane)[0],
                chain=in_lane(chain, lane),
                actors=in_lane(actors, lane),
                table=table,
            )
        for group in range(groups):
            group_site = in_group(site, group)[0]
            chain_stages.put_stage_acceleration(group_site, in_group(chain, group))
            chain_stages.use_stage(group_site, group_site.joints, weight, ahead_s)
    for lane in range(lanes):
        s = in_lane(site, lane)[0]
        if s.mode != _DIVERGED:
            is_adapting = adapts(s)
            if not chain_stages.end_stages(h_s, s, s.joints):
                s.mode = _DIVERGED
            finish_advance(s, in_lane(chain, lane), is_adapting)

    # Statistics of the run.
    for group in range(groups):
        chain_stages.put_gravity_torque(
            in_group(site, group)[0],
            in_group(chain, group),
            in_group(record, group)[record_row].floats,
            in_group(sums, group)[0].G,
        )
    for lane in range(lanes):
        s = in_lane(site, lane)[0]
        floats = in_lane(record, lane)[record_row].floats
        site_sums = in_lane(sums, lane)[0]
        update_peaks(
            row=floats,
            t_ns=t_ns,
            settled_rad=settled_rad,
            s=s,
            progress=in_lane(progress, lane)[0],
            peaks=in_lane(peaks, lane)[bucket].joints,
            sums=site_sums,
        )
        update_sums(
            k=k,
            t_ns=t_ns,
            s=s,
            chain=in_lane(chain, lane),
            environments=in_lane(environments, lane),
            table=table,
            row=floats,
            sums=site_sums,
        )
