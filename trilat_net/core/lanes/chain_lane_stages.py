"""Computes one control period of an arm with n joints, for several simulations at once.

`lane_stages` does the same for planar arms. Recursions from joint to joint are computed for
eight runs at a time, using `lane_vectors`. All other stages are loops over the runs, each of
which has its own lane (position in the vector registers).

Invariant:
    - No equation is repeated here. The functions, and the order of the stages, are those of
      `kernel`.
    - The joint frames of all lanes are up to date whenever a single-lane function needs them.
      `place_joints` therefore does nothing in a single lane.
"""

from collections.abc import Callable
from typing import Any

from ...records import Mode
from ..arms import chain_stages, task_space
from ..arms.chain import place_joints
from ..arms.exogenous import TorqueTable
from ..arms.task_space import POSE
from ..links.dominance import update_reference
from ..step.fused_run import first_sent_column, update_peaks, update_sums
from ..step.jit import lane_leaf, set_lane_form
from ..step.kernel import (
    adapts,
    emit_stage,
    finish_advance,
    guard_reference,
    guard_torque,
    hold_motor_torque,
    sum_trapezoid,
    updates_estimate,
)
from ..step.site_setup import Law, StaleAction
from ..step.vectors import Array, IntArray
from .lane_laws import compute_law
from .lane_rows import LaneRow, RowsInLane, in_lane
from .lane_stages import put_sent_numbers, use_states
from .lane_vectors import GROUP, in_group

_DIVERGED = int(Mode.DIVERGED)
_USER = int(Law.USER)
_GLIDE = int(StaleAction.GLIDE)


def _place_nothing(_chain: Any, _q: Any) -> None:
    """Does nothing. This is the version of `place_joints` for a single lane.

    The joint frames of all runs have already been computed, eight runs at a time.
    """


def _put_no_gravity(_s: Any, _chain: Any, _q: Any, _torque: Any) -> None:
    """Does nothing. This is the version of `put_gravity_torque` for a single lane.

    The torques of all runs have already been computed, eight runs at a time.
    """


def _choose_place(argument_types: tuple[Any, ...]) -> Callable[..., None]:
    """Returns the version of `place_joints` for a single simulation or for eight at once.

    `place_joints` computes the positions of an arm's joints. Numba calls this function with the
    argument types, which depend on the number of simulations.
    """
    dispatcher: Any = place_joints
    is_one_lane = isinstance(argument_types[0], RowsInLane)
    return _place_nothing if is_one_lane else dispatcher.py_func


def _choose_gravity(argument_types: tuple[Any, ...]) -> Callable[..., None]:
    """Returns the version of `put_gravity_torque` for a single simulation or for eight at once.

    Numba calls this function with the argument types, which depend on the number of
    simulations.
    """
    dispatcher: Any = chain_stages.put_gravity_torque
    is_one_lane = isinstance(argument_types[0], LaneRow)
    return _put_no_gravity if is_one_lane else dispatcher.py_func


def _skip(_s: Any) -> None:
    """Version of a one-argument function that does nothing."""


def _skip_two(_s: Any, _rows: Any) -> None:
    """Version of a two-argument function that does nothing."""


def _skip_task_torque(_s: Any, _gains: Any, _values: Any, _factor: float, _torque: Any) -> None:
    """Version of `add_task_torque` that does nothing."""


def _skip_without_task(function: Any, skipped: Callable[..., None]) -> None:
    """Makes Numba omit a task-space function if the runs do not use task space.

    Otherwise, Numba would compile the function, because it compiles all branches. Task-space
    functions are only called for eight runs at once.

    Args:
        function: The function, whose first argument is the state of a site.
        skipped: A function with the same arguments that does nothing.
    """

    def choose_form(argument_types: tuple[Any, ...]) -> Callable[..., None]:
        site = argument_types[0]
        is_skipped = isinstance(site, LaneRow) or site.find_constant("task") == 0
        return skipped if is_skipped else function.py_func

    set_lane_form(function, choose_form)


def _choose_model(argument_types: tuple[Any, ...]) -> Callable[..., None]:
    """Returns the compiled version of `update_model`, which computes the dynamics of an arm.

    The model is only needed by users' control laws. It is computed for eight runs at a time,
    with vector instructions, so the version for a single run does nothing.
    """
    dispatcher: Any = chain_stages.update_model
    site = argument_types[0]
    is_skipped = isinstance(site, LaneRow) or site.find_constant("law") != _USER
    return _skip_two if is_skipped else dispatcher.py_func


_skip_without_task(task_space.update_pose, _skip_two)
_skip_without_task(task_space.update_task_errors, _skip)
_skip_without_task(task_space.update_orientation_reference, _skip_two)
_skip_without_task(task_space.update_wrench, _skip)
_skip_without_task(task_space.add_task_torque, _skip_task_torque)
set_lane_form(chain_stages.update_model, _choose_model)
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
    law: Any,
    received: Any,
    sent: Any,
    code: Any,
    chain: Any,
    states: Array,
    used: IntArray,
    columns: IntArray,
    table: TorqueTable,
) -> None:
    """Computes one control period of an arm for several simulations that run side by side.

    The arm is a chain of joints. See `advance_site` for the planar arm. All arrays have one
    entry (lane) per simulation, and no two arrays may overlap in memory.

    Args:
        k: Current tick.
        t_ns: Nominal time of the tick, ns since the epoch.
        lanes: Number of lanes to compute, at most `LANES`.
        settled_rad: Position error below which an arm counts as settled, rad.
        i: Index of the site.
        block_row: Row of the tick in `used`.
        pages: Number of latest states stored per site in `states`, a power of two.
        bucket: Row of the tick in `peaks`.
        record_row: Row of the tick in `record`.
        site: Row of the site.
        links: Rows of its links.
        actors: Rows of its operators and environments.
        environments: Rows of its environments only.
        ramps: Row of planned changes of its dominance factors.
        record: Rows of its latest records; one is written.
        peaks: Peaks of the site, one row per bucket, see `update_peaks`.
        sums: Sums of the site.
        progress: Progress of the site.
        law: Row with the gains and memory of the site's compiled law.
        received: Rows with the values sent by the peers' laws.
        sent: Row with the values sent by this law.
        code: Selects the code of the law, see `LawCode`.
        chain: Rows of the joints.
        states: The latest states of all sites, see `advance_site`.
        used: Sample in use by peer, lane and tick of a block; -1 before the first.
        columns: Indices of the received values, see `LaneLaw`, shape (P, C).
        table: Tables of the operators and environments of all sites, the same in all runs.
    """
    groups = (lanes + GROUP - 1) // GROUP

    use_states(
        t_ns=t_ns,
        lanes=lanes,
        i=i,
        block_row=block_row,
        pages=pages,
        shared=in_lane(site, 0)[0].shared,
        site=site,
        links=links,
        received=received,
        states=states,
        used=used,
        columns=columns,
    )

    # 3 reference
    for lane in range(lanes):
        update_reference(
            t_ns,
            in_lane(site, lane)[0],
            in_lane(links, lane),
            in_lane(ramps, lane)[0].rows,
        )
    for group in range(groups):
        group_site = in_group(site, group)[0]
        chain_stages.place_chain(group_site, in_group(chain, group))
        if group_site.task and group_site.shared == POSE:
            task_space.update_orientation_reference(group_site, in_group(links, group))
    for lane in range(lanes):
        guard_reference(k, t_ns, in_lane(site, lane)[0], in_lane(links, lane))

    # 4 errors, 5 estimate. A run has ended if one of its arms has left its limits.
    for group in range(groups):
        group_site = in_group(site, group)[0]
        chain_stages.update_errors(group_site, in_group(chain, group))
        if group_site.on_stale != _GLIDE and updates_estimate(k, group_site):
            sum_trapezoid(group_site)
            half_s = 0.5 / group_site.rate_hz
            chain_stages.advance_estimate(group_site, half_s, group_site.Yr_before)
    if in_lane(site, 0)[0].on_stale == _GLIDE:
        for lane in range(lanes):
            s = in_lane(site, lane)[0]
            if updates_estimate(k, s) and adapts(s):
                sum_trapezoid(s)
                chain_stages.advance_estimate(s, 0.5 / s.rate_hz, s.Yr_before)
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
        group_site = in_group(site, group)[0]
        if group_site.task:
            task_space.update_wrench(group_site)
        if group_site.law != _USER:
            chain_stages.update_torque(group_site, in_group(chain, group))
        elif group_site.theta_known != 0:
            chain_stages.update_model(group_site, in_group(chain, group))
    for lane in range(lanes):
        compute_law(
            code,
            k,
            t_ns,
            in_lane(site, lane),
            in_lane(links, lane),
            in_lane(chain, lane),
            in_lane(law, lane),
            in_lane(received, lane),
            in_lane(sent, lane),
        )
    for lane in range(lanes):
        s = in_lane(site, lane)[0]
        floats = in_lane(record, lane)[record_row].floats
        guard_torque(k, t_ns, s, in_lane(chain, lane))
        emit_stage(s, floats)
        joints = s.joints
        shared = s.shared
        page = k & (pages - 1)
        q_column = 0
        qd_column = joints
        tau_x_column = 3 * joints + 2 * shared
        if s.task:
            q_column = first_sent_column(s) - 3 * shared
            qd_column = q_column + shared
            tau_x_column = qd_column + shared
        for c in range(shared):
            states[i, page, lane, c] = floats[q_column + c]
            states[i, page, lane, shared + c] = floats[qd_column + c]
            states[i, page, lane, 2 * shared + c] = floats[tau_x_column + c]

    put_sent_numbers(
        k=k,
        lanes=lanes,
        i=i,
        pages=pages,
        record_row=record_row,
        shared=in_lane(site, 0)[0].shared,
        site=site,
        record=record,
        sent=sent,
        states=states,
    )

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
