"""Computes one control period of an arm for several runs at once.

Each run has a lane (a position in the processor's vector registers). Each stage of the period,
for example the torque of the control law, is a loop over the lanes that calls the kernel
function for one run. Stages have separate loops, because the compiler can then vectorise each
of them.

Invariant:
    - No equation of a control period is repeated here.
    - The results of a lane do not depend on the other lanes.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ...records import Mode
from ..arms import two_link_stages
from ..arms.exogenous import (
    NO_TORQUE,
    SourceTorque,
    TorqueTable,
    add_source_torque,
    torque_on_arm,
)
from ..links.dominance import update_reference
from ..plug.plugged import call_address
from ..step.fused_run import NEVER_NS, first_sent_column, update_peaks, update_sums
from ..step.jit import lane_leaf, leaf, set_lane_form
from ..step.kernel import (
    adapts,
    emit_stage,
    error_stages,
    finish_advance,
    guard_reference,
    guard_torque,
    hold_motor_torque,
    torque_stage,
)
from ..step.site_setup import Law, StaleAction
from ..step.ticks import BUCKETS_PER_S, tick_ns
from ..step.vectors import Array, IntArray, Vector, put_pair, read_five, read_pair
from .lane_laws import compute_law
from .lane_rows import Words, in_lane, number_of, pointer_to, select_row

_DIVERGED = int(Mode.DIVERGED)
_USER = int(Law.USER)
_GLIDE = int(StaleAction.GLIDE)
JOINTS = 2
"""Number of joints of the arms that lanes support."""
TAU_X_COLUMN = 5 * JOINTS
"""Column of tau_x in a record, after q, qd, q_des, qd_des and tau."""
STAGES_DTYPE = np.dtype(
    [(name, "f8", (JOINTS,)) for name in ("qdd_1", "qd_2", "qdd_2", "qd_3", "qdd_3")]
)
"""Layout of the velocities and accelerations at the first stages of the integrator."""


def _no_torque(
    _t_s: float,
    _q: Vector,
    _qd: Vector,
    _lengths: Vector,
    _actors: Any,
    _table: TorqueTable,
    _sampled: int,
) -> SourceTorque:
    """Returns zero torque: `torque_on_arm` of an arm without operators and environments."""
    return NO_TORQUE


def _unroll_sources(count: int) -> Callable[..., SourceTorque]:
    """Returns a function that adds the torques of a fixed number of operators and environments.

    It replaces the loop in `torque_on_arm`. The compiler knows the type of each operator and
    environment only if its index is a constant instead of a loop variable. The loop is
    therefore unrolled: the function for n torque sources calls the function for n - 1 torque
    sources.

    Args:
        count: Number of operators and environments that act on the arm.
    """
    if count == 0:
        return _no_torque
    last = count - 1
    torque_of_others = leaf(_unroll_sources(last))

    def torque_of_all(
        t_s: float,
        q: Vector,
        qd: Vector,
        lengths: Vector,
        actors: Any,
        table: TorqueTable,
        sampled: int,
    ) -> SourceTorque:
        total = torque_of_others(t_s, q, qd, lengths, actors, table, sampled)
        actor = select_row(actors, last)
        return add_source_torque(total, t_s, q, qd, lengths, actor, table, sampled)

    return torque_of_all


def _choose_form(argument_types: tuple[Any, ...]) -> Callable[..., SourceTorque]:
    """Returns the version of `torque_on_arm` for the number of operators and environments.

    The compiler calls this function with the argument types.
    """
    actors = argument_types[4]
    return _unroll_sources(actors.count)


set_lane_form(torque_on_arm, _choose_form)


@leaf
def _advance_stage(
    t_s: float,
    ahead_s: float,
    s: Any,
    qd_before: Vector,
    qdd_before: Vector,
    actors: Any,
    table: TorqueTable,
) -> Any:
    """Evaluates one stage of the Runge-Kutta step of a planar arm in one of several runs.

    Calls `two_link_stages.advance_stage` with the values of the run.

    Args:
        t_s: Time at the start of the period, s.
        ahead_s: Time of the stage after the start of the period, s.
        s: State of the site.
        qd_before: Joint velocities at the previous stage, rad/s.
        qdd_before: Joint accelerations at the previous stage, rad/s^2.
        actors: Rows of the operators and environments that act on the arm.
        table: Data tables to which these rows refer.
    """
    return two_link_stages.advance_stage(
        t_s=t_s,
        ahead_s=ahead_s,
        q=read_pair(s.q),
        qd=read_pair(s.qd),
        qd_before=qd_before,
        qdd_before=qdd_before,
        u=read_pair(s.u),
        theta=read_five(s.theta),
        g=s.g,
        lengths=read_pair(s.lengths),
        actors=actors,
        table=table,
    )


@leaf
def use_states(
    t_ns: Any,
    lanes: int,
    i: int,
    block_row: int,
    pages: int,
    shared: int,
    site: Any,
    links: Any,
    received: Any,
    states: Array,
    used: IntArray,
    columns: IntArray,
) -> None:
    """Copies the peers' states that an arm uses in a tick to the links of the arm.

    This is stage 2 of the tick (release).

    Args:
        t_ns: Nominal time of the tick, ns since the epoch, see `number_of`.
        lanes: Number of lanes to compute.
        i: Index of the site.
        block_row: Row of the tick in `used`.
        pages: Number of latest states stored per site in `states`, a power of two.
        shared: Number of coordinates that sites share.
        site: Row of the site.
        links: Rows of its links; updated in place.
        received: Rows with the values sent by the peers' laws; updated in place.
        states: The latest states of all sites, see `advance_site`.
        used: Sample in use, for each peer, lane and tick of a block; -1 before the first.
        columns: Indices of the received values, see `LaneLaw`, shape (P, C).
    """
    for lane in range(lanes):
        rows = in_lane(links, lane)
        s = in_lane(site, lane)[0]
        for p in range(rows.shape[0]):
            link = rows[p]
            lane_ns = number_of(t_ns, lane)
            sample = used[p, lane, block_row]
            # The peers of a site are all other sites, in scenario order.
            peer = p if p < i else p + 1
            page = pages if sample < 0 else sample & (pages - 1)
            if s.law == _USER or s.on_stale == _GLIDE:
                link.new = sample > link.used
                link.used_ns = lane_ns if sample > link.used else link.used_ns
            link.used = sample
            for c in range(shared):
                link.q[c] = states[peer, page, lane, c]
                link.qd[c] = states[peer, page, lane, shared + c]
                link.tau_x[c] = states[peer, page, lane, 2 * shared + c]

    for p in range(columns.shape[0]):
        peer = p if p < i else p + 1
        for c in range(columns.shape[1]):
            column = columns[p, c]
            for lane in range(lanes):
                sample = used[p, lane, block_row]
                number = 0.0
                if sample >= 0 and column >= 0:
                    number = states[peer, sample & (pages - 1), lane, 3 * shared + column]
                in_lane(received, lane)[p].numbers[c] = number


@leaf
def put_sent_numbers(
    k: Any,
    lanes: int,
    i: int,
    pages: int,
    record_row: int,
    shared: int,
    site: Any,
    record: Any,
    sent: Any,
    states: Array,
) -> None:
    """Copies the values sent by an arm's control law to the arm's record and latest state.

    Args:
        k: Current tick, see `number_of`.
        lanes: Number of lanes to compute.
        i: Index of the site.
        pages: Number of latest states stored per site in `states`, a power of two.
        record_row: Row of the tick in `record`.
        shared: Number of coordinates that sites share.
        site: Row of the site.
        record: Rows of its latest records; one is updated.
        sent: Row with the values sent by the law.
        states: The latest states of all sites, see `advance_site`; updated in place.
    """
    for c in range(in_lane(site, 0)[0].sent):
        for lane in range(lanes):
            number = in_lane(sent, lane)[0].numbers[c]
            floats = in_lane(record, lane)[record_row].floats
            floats[first_sent_column(in_lane(site, lane)[0]) + c] = number
            states[i, number_of(k, lane) & (pages - 1), lane, 3 * shared + c] = number


@lane_leaf
def advance_site(
    k: Any,
    t_ns: Any,
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
    scratch: Any,
    law: Any,
    received: Any,
    sent: Any,
    code: Any,
    _chain: Any,
    states: Array,
    used: IntArray,
    columns: IntArray,
    table: TorqueTable,
) -> None:
    """Computes one control period of an arm for several simulations that run side by side.

    All arrays have one entry (lane) per simulation, and no two arrays may overlap in memory.

    Args:
        k: Current tick, for all lanes or per lane, see `number_of`.
        t_ns: Nominal time of the tick, ns since the epoch, for all lanes or per lane.
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
        scratch: Row that buffers the stages of the integrator, see `STAGES_DTYPE`.
        law: Row with the gains and memory of the site's compiled law.
        received: Rows with the values sent by the peers' laws.
        sent: Row with the values sent by this law.
        code: Selects the code of the law, see `LawCode`.
        states: The latest states of all sites (q, qd, tau_x and the values sent by the law),
            shape (N, pages + 1, LANES, width). The last page holds the state before the first
            tick.
        used: Sample in use, for each peer, lane and tick of a block; -1 before the first.
        columns: Indices of the received values, see `LaneLaw`, shape (P, C).
        table: Tables of the operators and environments of all sites, the same in all runs.
    """
    use_states(
        t_ns=t_ns,
        lanes=lanes,
        i=i,
        block_row=block_row,
        pages=pages,
        shared=JOINTS,
        site=site,
        links=links,
        received=received,
        states=states,
        used=used,
        columns=columns,
    )

    # 3 reference, 4 errors, 5 estimate. The branches of the rule `glide` have their own loops,
    # because a loop with branches does not use vector instructions.
    glides = in_lane(site, 0)[0].on_stale == _GLIDE
    if glides:
        for lane in range(lanes):
            update_reference(
                number_of(t_ns, lane),
                in_lane(site, lane)[0],
                in_lane(links, lane),
                in_lane(ramps, lane)[0].rows,
            )
        for lane in range(lanes):
            guard_reference(
                number_of(k, lane),
                number_of(t_ns, lane),
                in_lane(site, lane)[0],
                in_lane(links, lane),
            )
    for lane in range(lanes):
        s = in_lane(site, lane)[0]
        if not glides:
            rows = in_lane(links, lane)
            update_reference(number_of(t_ns, lane), s, rows, in_lane(ramps, lane)[0].rows)
            guard_reference(number_of(k, lane), number_of(t_ns, lane), s, rows)
        error_stages(
            k=number_of(k, lane),
            t_ns=number_of(t_ns, lane),
            s=s,
            chain=None,
            actors=in_lane(actors, lane),
            table=table,
        )

    # 6 torque
    for lane in range(lanes):
        torque_stage(in_lane(site, lane), None)
    for lane in range(lanes):
        compute_law(
            code,
            number_of(k, lane),
            number_of(t_ns, lane),
            in_lane(site, lane),
            in_lane(links, lane),
            None,
            in_lane(law, lane),
            in_lane(received, lane),
            in_lane(sent, lane),
        )

    # 6 limits of the torque, 7 emit
    if glides:
        for lane in range(lanes):
            s = in_lane(site, lane)[0]
            guard_torque(number_of(k, lane), number_of(t_ns, lane), s, None)
    for lane in range(lanes):
        floats = in_lane(record, lane)[record_row].floats
        s = in_lane(site, lane)[0]
        if not glides:
            guard_torque(number_of(k, lane), number_of(t_ns, lane), s, None)
        emit_stage(s, floats)
        page = number_of(k, lane) & (pages - 1)
        for c in range(JOINTS):
            states[i, page, lane, c] = floats[c]
            states[i, page, lane, JOINTS + c] = floats[JOINTS + c]
            states[i, page, lane, 2 * JOINTS + c] = floats[TAU_X_COLUMN + c]

    put_sent_numbers(
        k=k,
        lanes=lanes,
        i=i,
        pages=pages,
        record_row=record_row,
        shared=JOINTS,
        site=site,
        record=record,
        sent=sent,
        states=states,
    )

    # 8 advance. Each stage of the integrator has its own loop. In a short loop, the processor
    # can start on the next lanes while waiting for the results of the previous ones.
    for lane in range(lanes):
        s = in_lane(site, lane)[0]
        if s.mode != _DIVERGED:
            hold_motor_torque(number_of(k, lane), s)
        stages = in_lane(scratch, lane)[0]
        qdd = two_link_stages.find_stage_acceleration(
            t_s=number_of(t_ns, lane) * 1e-9,
            q=read_pair(s.q),
            qd=read_pair(s.qd),
            u=read_pair(s.u),
            theta=read_five(s.theta),
            g=s.g,
            lengths=read_pair(s.lengths),
            actors=in_lane(actors, lane),
            table=table,
        )
        put_pair(stages.qdd_1, qdd)
    for lane in range(lanes):
        s = in_lane(site, lane)[0]
        stages = in_lane(scratch, lane)[0]
        qd, qdd = _advance_stage(
            t_s=number_of(t_ns, lane) * 1e-9,
            ahead_s=0.5 * (1.0 / s.rate_hz),
            s=s,
            qd_before=read_pair(s.qd),
            qdd_before=read_pair(stages.qdd_1),
            actors=in_lane(actors, lane),
            table=table,
        )
        put_pair(stages.qd_2, qd)
        put_pair(stages.qdd_2, qdd)
    for lane in range(lanes):
        s = in_lane(site, lane)[0]
        stages = in_lane(scratch, lane)[0]
        qd, qdd = _advance_stage(
            t_s=number_of(t_ns, lane) * 1e-9,
            ahead_s=0.5 * (1.0 / s.rate_hz),
            s=s,
            qd_before=read_pair(stages.qd_2),
            qdd_before=read_pair(stages.qdd_2),
            actors=in_lane(actors, lane),
            table=table,
        )
        put_pair(stages.qd_3, qd)
        put_pair(stages.qdd_3, qdd)
    for lane in range(lanes):
        s = in_lane(site, lane)[0]
        stages = in_lane(scratch, lane)[0]
        h_s = 1.0 / s.rate_hz
        qd_4, qdd_4 = _advance_stage(
            t_s=number_of(t_ns, lane) * 1e-9,
            ahead_s=h_s,
            s=s,
            qd_before=read_pair(stages.qd_3),
            qdd_before=read_pair(stages.qdd_3),
            actors=in_lane(actors, lane),
            table=table,
        )
        q, qd = two_link_stages.combine_stages(
            h_s=h_s,
            q=read_pair(s.q),
            qd=read_pair(s.qd),
            qd_2=read_pair(stages.qd_2),
            qd_3=read_pair(stages.qd_3),
            qd_4=qd_4,
            qdd_1=read_pair(stages.qdd_1),
            qdd_2=read_pair(stages.qdd_2),
            qdd_3=read_pair(stages.qdd_3),
            qdd_4=qdd_4,
        )
        if s.mode != _DIVERGED:
            is_adapting = adapts(s)
            if not two_link_stages.move_arm(s, q, qd):
                s.mode = _DIVERGED
            finish_advance(s, None, is_adapting)

    # Statistics of the run.
    for lane in range(lanes):
        s = in_lane(site, lane)[0]
        floats = in_lane(record, lane)[record_row].floats
        site_sums = in_lane(sums, lane)[0]
        update_peaks(
            row=floats,
            t_ns=number_of(t_ns, lane),
            settled_rad=settled_rad,
            s=s,
            progress=in_lane(progress, lane)[0],
            peaks=in_lane(peaks, lane)[bucket].joints,
            sums=site_sums,
        )
        update_sums(
            k=number_of(k, lane),
            t_ns=number_of(t_ns, lane),
            s=s,
            chain=None,
            environments=in_lane(environments, lane),
            table=table,
            row=floats,
            sums=site_sums,
        )


class EndedRuns(NamedTuple):
    """States of runs that have ended, at the time at which one of their arms left its limits.

    A run that has ended stays in its lane, but its later values are meaningless. Its last valid
    state is therefore copied here. N is the number of sites, and the last axis of each array is
    the lane.

    Attributes:
        ticks: Number of ticks executed by the first site of each run, shape (LANES,). -1 if the
            run has not ended.
        site_ticks: Number of ticks executed by each site, shape (N, LANES).
        site_rows: Rows of the sites, shape (N, words per row, LANES).
        links: Rows of the links, shape (N P, words per row, LANES). Only `LaneEpisodes` keeps
            them, because copying them in `keep_ended_runs` slows down every tick considerably.
        records: Records, shape (N, floats, LANES).
        sums: Rows of the sums, shape (N, words per row, LANES).
        progress: Rows of the progress, shape (N, words per row, LANES).
        laws: Gains and memory of compiled laws, shape (N, values, LANES).
        sent: Values sent by these laws, shape (N, values, LANES).
        peaks: Largest values in the 50 ms interval (bucket) of the last tick, shape
            (N, 3 n, LANES).
    """

    ticks: IntArray
    site_ticks: IntArray
    site_rows: Words
    links: Words
    records: Words
    sums: Words
    progress: Words
    laws: Words
    sent: Words
    peaks: Words


@leaf
def copy_lane(lane: int, source: Words, target: Words) -> None:
    """Copies the state of one run between two arrays that hold the states of several runs.

    Args:
        lane: Lane index of the run.
        source: Values of all sites in all runs, shape (N, values, LANES).
        target: Output array of the same form.
    """
    for i in range(source.shape[0]):
        for word in range(source.shape[1]):
            target[i, word, lane] = source[i, word, lane]


@leaf
def keep_ended_runs(
    ticks: Any,
    runs: int,
    mode_word: int,
    latest: IntArray,
    peaks: Words,
    present: EndedRuns,
    ended: EndedRuns,
) -> int:
    """Stores the final state of each run in which an arm left its limits in this tick.

    The other runs continue, which overwrites the values in the lane of a run that has ended.

    Args:
        ticks: Number of ticks executed by the first site: a single value for all runs, or one
            per run.
        runs: Number of runs.
        mode_word: Index of the mode among the words of a site's row.
        latest: For each site, its number of ticks, the bucket of its latest tick, and the row
            of that tick's record, shape (3, N).
        peaks: Peaks of all sites, shape (N, buckets, 3 n, LANES).
        present: Current values of all runs, with several rows of records per site. Its peaks
            are not used.
        ended: Output for the values of runs that end in this tick.

    Returns:
        The number of runs that have not ended.
    """
    running = 0
    for lane in range(runs):
        if ended.ticks[lane] >= 0:
            continue
        has_diverged = False
        for i in range(present.site_rows.shape[0]):
            has_diverged = has_diverged or present.site_rows[i, mode_word, lane] == _DIVERGED
        if not has_diverged:
            running += 1
            continue
        ended.ticks[lane] = number_of(ticks, lane)
        copy_lane(lane, present.site_rows, ended.site_rows)
        copy_lane(lane, present.sums, ended.sums)
        copy_lane(lane, present.progress, ended.progress)
        copy_lane(lane, present.laws, ended.laws)
        copy_lane(lane, present.sent, ended.sent)
        for i in range(ended.site_ticks.shape[0]):
            ended.site_ticks[i, lane] = latest[0, i]
            copy_lane(lane, peaks[i : i + 1, latest[1, i]], ended.peaks[i : i + 1])
            record = present.records[i : i + 1, latest[2, i]]
            copy_lane(lane, record, ended.records[i : i + 1])
    return running


class RecordedHands(NamedTuple):
    """Torques or targets with which live operators moved the arms in a recorded run.

    They are applied again when the run is repeated, see `ReplayedInputs`.

    Attributes:
        actions: Actions of the operators, shape (N, ticks, C).
        rows: For each site, the row of its live operator among all operators and environments,
            or -1 if there is none.
        row_words: Words of the row that the actions replace.
        columns: For each of these words, its column in the action.
    """

    actions: Array
    rows: IntArray
    row_words: IntArray
    columns: IntArray


@leaf
def _apply_recorded_hand(
    i: int, k: int, lanes: int, hands: RecordedHands, actors: Array
) -> None:
    """Repeats an operator's action from a recorded run, in one control period of all copies.

    The copies of the run are simulated side by side (in lanes).

    Args:
        i: Index of the site.
        k: Current tick.
        lanes: Number of lanes.
        hands: Actions of the operators.
        actors: Rows of operators and environments, viewed as floats; updated in place.
    """
    if hands.rows[i] < 0 or k >= hands.actions.shape[1]:
        return
    for n in range(hands.row_words.shape[0]):
        for lane in range(lanes):
            action = hands.actions[i, k, hands.columns[n]]
            actors[hands.rows[i], hands.row_words[n], lane] = action


@leaf
def call_site(
    address: int,
    k: Any,
    t_ns: Any,
    lanes: int,
    settled_rad: float,
    i: int,
    block_row: int,
    pages: int,
    bucket: int,
    record_row: int,
    tables: IntArray,
    states: Array,
    used: IntArray,
    columns: IntArray,
    table: Array,
) -> None:
    """Calls the compiled code that computes one control period of an arm for several runs.

    The arguments after `address` are those of `advance_site`, except that `tables` contains the
    addresses of the tables from `site` to `_chain`, in the same order.

    Args:
        address: Address of the code of `advance_site` or `advance_chain_site`.
        k: The tick of all lanes, or a pointer to the tick of each lane.
        t_ns: Nominal time of the tick, ns since the epoch, in the same form as `k`.
        lanes: Number of lanes to compute.
        settled_rad: Position error below which an arm counts as settled, rad.
        i: Index of the site.
        block_row: Row of the tick in `used`.
        pages: Number of latest states stored per site in `states`.
        bucket: Row of the tick in the table of peaks.
        record_row: Row of the tick in the table of records.
        tables: Addresses of the tables of the site, shape (15,).
        states: The latest states of all sites.
        used: Samples that the site uses.
        columns: Indices of the values received by the site's law.
        table: Tables of the operators and environments.
    """
    call_address(
        address,
        (
            k,
            t_ns,
            lanes,
            settled_rad,
            i,
            block_row,
            pages,
            bucket,
            record_row,
            pointer_to(tables[0]),
            pointer_to(tables[1]),
            pointer_to(tables[2]),
            pointer_to(tables[3]),
            pointer_to(tables[4]),
            pointer_to(tables[5]),
            pointer_to(tables[6]),
            pointer_to(tables[7]),
            pointer_to(tables[8]),
            pointer_to(tables[9]),
            pointer_to(tables[10]),
            pointer_to(tables[11]),
            pointer_to(tables[12]),
            pointer_to(tables[13]),
            pointer_to(tables[14]),
            states,
            used,
            columns,
            table,
        ),
    )


@leaf
def run_block(
    first: IntArray,
    ticks: IntArray,
    end: IntArray,
    rates_hz: IntArray,
    next_ns: IntArray,
    latest: IntArray,
    runs: int,
    settled_rad: float,
    pages: int,
    mode_word: int,
    record_rows: int,
    addresses: IntArray,
    tables: IntArray,
    states: Array,
    used: IntArray,
    columns: IntArray,
    table: Array,
    hands: RecordedHands,
    actors: Array,
    peaks: Words,
    present: EndedRuns,
    ended: EndedRuns,
) -> int:
    """Simulates several runs side by side for a number of control periods, or until all end.

    Args:
        first: First tick of each site in the block, shape (N,).
        ticks: Number of ticks executed by each site, shape (N,); updated in place.
        end: First tick of each site after the block, shape (N,).
        rates_hz: Tick rates, Hz, shape (N,).
        next_ns: Buffer for the time of the next tick of each site, ns, shape (N,).
        latest: Buffer for information about the latest tick, see `keep_ended_runs`.
        runs: Number of runs.
        settled_rad: Position error below which an arm counts as settled, rad.
        pages: Number of latest states stored per site, a power of two.
        mode_word: Index of the mode among the words of a site's row.
        record_rows: Number of latest records kept per site, a power of two.
        addresses: Address of the code of `advance_site` or `advance_chain_site` for each site,
            shape (N,).
        tables: For each site, the addresses of its tables, in the order of the arguments of
            `advance_site`, shape (N, 15).
        states: The latest states of all sites, see `advance_site`.
        used: Samples in use, shape (N, P, LANES, ticks), see `use_samples`.
        columns: Indices of the values that laws receive, shape (N, P, C).
        table: Tables of the operators and environments.
        hands: Actions of live operators in a recorded run.
        actors: Rows of operators and environments, viewed as floats.
        peaks: Peaks of all sites, shape (N, buckets, 3 n, LANES).
        present: Current values of all runs.
        ended: Values of the runs that have ended; updated in place.

    Returns:
        The number of runs that have not ended.
    """
    running = runs
    # Compute complete vector registers, although the results in lanes without a run are
    # meaningless. For one or two additional lanes, scalar code is faster.
    lanes = runs if 0 < runs % 8 <= 2 else (runs + 7) // 8 * 8
    for i in range(addresses.shape[0]):
        next_ns[i] = tick_ns(ticks[i], rates_hz[i]) if ticks[i] < end[i] else NEVER_NS
    while True:
        # As in `run_until`: by nominal time, and at equal times in the order of the sites.
        t_ns = NEVER_NS
        for i in range(addresses.shape[0]):
            t_ns = min(t_ns, next_ns[i])
        if t_ns == NEVER_NS:
            return running
        for i in range(addresses.shape[0]):
            if next_ns[i] != t_ns:
                continue
            k = ticks[i]
            latest[0, i] = k + 1
            latest[1, i] = k * BUCKETS_PER_S // rates_hz[i]
            latest[2, i] = k & (record_rows - 1)
            _apply_recorded_hand(i, k, lanes, hands, actors)
            call_site(
                address=addresses[i],
                k=k,
                t_ns=t_ns,
                lanes=lanes,
                settled_rad=settled_rad,
                i=i,
                block_row=k - first[i],
                pages=pages,
                bucket=latest[1, i],
                record_row=latest[2, i],
                tables=tables[i],
                states=states,
                used=used[i],
                columns=columns[i],
                table=table,
            )
            ticks[i] = k + 1
            next_ns[i] = tick_ns(k + 1, rates_hz[i]) if k + 1 < end[i] else NEVER_NS
        running = keep_ended_runs(
            ticks=ticks[0],
            runs=runs,
            mode_word=mode_word,
            latest=latest,
            peaks=peaks,
            present=present,
            ended=ended,
        )
        if running == 0:
            return running
