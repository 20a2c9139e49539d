"""The virtual-time driver without a log: all sites in one compiled loop, about 1000 times real
time.

It keeps the peaks of every 50 ms, and sums over the run, in place of records.

Invariant: the result equals `execution.virtual` with its default network, bit for bit;
scenarios that the compiled loop cannot run are refused. Between two states only floating-point
numbers are mixed; counters, times and modes are those of one of them, and numbers that are
equal in both stay as they are, bit for bit.

A run with the inputs of a log is the recorded one, bit for bit. A sample that came before its
own stamp is handed over at the first tick after it: none is in use earlier (L2).
"""

import math
from collections import deque
from collections.abc import Collection, Mapping, Sequence
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ..core.compiled_law import CompiledLaw, plug_law
from ..core.delay import max_delay_us
from ..core.exogenous import LIVE_KINDS
from ..core.fused_run import (
    NEVER_NS,
    PROGRESS_DTYPE,
    KeptRecords,
    LawArrays,
    RecordedFeed,
    finish_site,
    largest_of_joints,
    run_until,
    sense_site,
    sums_dtype,
)
from ..core.law_view import PlainLaw
from ..core.site_arrays import SiteArrays, select_site, stack_site_arrays, take_change
from ..core.site_setup import SiteSetup
from ..core.ticks import BUCKETS_PER_S, MAX_ARRIVALS, NS_PER_S, CoreChange, Mode, tick_ns
from ..core.vectors import Array, IntArray, Row, RowArray
from ..errors import LawFailed, ScenarioError, count_nouns
from ..log.log_reader import Log
from ..scenario import Scenario
from ..scenario.code_consent import find_user_laws
from ..scenario.operators.kernel_operators import Wall
from ..scenario.operators.program_hand import make_hand_players
from ..scenario.own_plant import PlantPlayer
from ..scenario.validate import refuse_external_arms


def _float_words(dtype: np.dtype[np.generic]) -> NDArray[np.bool_]:
    if dtype.fields is None:
        return np.full(max(1, dtype.itemsize // 8), dtype.base.kind == "f")
    words = np.zeros(dtype.itemsize // 8, dtype=bool)
    for field, offset, *_ in dtype.fields.values():
        words[offset // 8 : (offset + field.itemsize) // 8] = _float_words(field)
    return words


class RunState:
    """The arrays that a run changes, all of words of eight bytes; they stay where they are."""

    def __init__(self, arrays: Sequence[NDArray[np.generic]]) -> None:
        self._words: list[NDArray[np.int64]] = []
        self._floats: list[NDArray[np.bool_]] = []
        for array in arrays:
            if array.size:
                flat = array.reshape(-1).view(np.int64)
                assert np.shares_memory(flat, array)  # a copy would not be the run's
                self._words.append(flat)
                self._floats.append(np.tile(_float_words(array.dtype), array.size))

    def scale_difference(self, other: "RunState", factor: float) -> None:
        """Becomes another state of the same run plus so much of the difference to it; 0: its
        very bits.
        """
        for own, its, floats in zip(self._words, other._words, self._floats, strict=True):
            if factor == 0.0:
                own[:] = its
                continue
            changed = np.flatnonzero((own != its) & floats)
            x = own.view(np.float64)[changed]
            y = its.view(np.float64)[changed]
            mixed: Array = y + factor * (x - y)
            own[:] = its
            own.view(np.float64)[changed] = np.where(np.isfinite(mixed), mixed, y)


def check_fusable(scenario: Scenario, plants: Collection[str] = ()) -> None:
    """Refuses a scenario that the compiled loop cannot run; arms of `plants` are moved by
    those.

    Raises:
        ScenarioError: another arm is external, or a site is so much slower than another that
            too many samples would arrive in one of its ticks.
    """
    refuse_external_arms(scenario, plants)
    if (ratio := _largest_ratio(scenario)) > MAX_ARRIVALS:
        raise ScenarioError(
            f"the fastest site makes {count_nouns(ratio, 'tick')} within one of the "
            f"slowest, at most {MAX_ARRIVALS} "
            "are taken",
            path="rate_hz",
            source=scenario.name,
        )


def _largest_ratio(scenario: Scenario) -> int:
    rates_hz = [spec.rate_hz for spec in scenario.sites.values()]
    return math.ceil(max(rates_hz) / min(rates_hz))


class HandActor(Protocol):
    """A live hand in a compiled run."""

    def compute_actions(self, k: int, end: int, arrays: SiteArrays) -> Array:
        """Returns what it does from tick k until it needs the arm again, before tick `end`, a
        row a tick.

        A row is as `HandInForce`.
        """


class RunTotals(NamedTuple):
    """Numbers of a whole run.

    Attributes:
        rms_error_rad: RMS of e of the worst joint of all sites.
        effort_nm: RMS over sites and joints of tau - G(q), the torque beyond what gravity asks.
        force_peak_n: the largest force of a wall; None without a wall.
        walls_j: the work of the environments on the arms; None without one.
    """

    rms_error_rad: float
    effort_nm: float
    force_peak_n: float | None
    walls_j: float | None


class RunInputs(NamedTuple):
    """What a recorded run got from outside, for a run that is to be the same.

    Attributes:
        feed: arrivals, and what live hands did.
        changes: the tick before which a site takes a change in, the site's place, and the
            change, by time.
        late_ns: by how much samples came late, at the most, ns.
        longest_us: the longest delay that a change gave a link, us.
    """

    feed: RecordedFeed
    changes: Sequence[tuple[int, int, CoreChange]] = ()
    late_ns: int = 0
    longest_us: int = 0


def make_prompt_inputs(sites: int) -> RunInputs:
    """Returns the inputs of a run in virtual time: every sample comes at once, and no live hand
    acts.
    """
    nothing = RecordedFeed(
        np.zeros((sites, max(sites - 1, 1), 0), np.int64),
        np.zeros(0, np.int64),
        np.zeros((sites, 0, 1)),
        np.full(sites, -1),
    )
    return RunInputs(nothing)


class FusedRun:
    """A run of all sites of a scenario; from |e| = `settled_rad` on, a site is not settled.

    Laws that are compiled run in the loop; those in plain Python are asked between its stages,
    tick by tick. `keep` of a site's last records are kept for `pop_records`. With `inputs` it
    is a recorded run again; else hands of one's own act, and `hands` in their place: the loop
    pauses where one is asked. `plants` move arms of sites, between any two ticks.

    Raises:
        ScenarioError: see `check_fusable`; or a law cannot be made.
    """

    def __init__(
        self,
        scenario: Scenario,
        settled_rad: float = 0.01,
        keep: int = 0,
        inputs: RunInputs | None = None,
        hands: Mapping[str, HandActor] = {},
        plants: Mapping[str, PlantPlayer] = {},
    ) -> None:
        check_fusable(scenario, plants)
        self._scenario = scenario
        self._settled_rad = settled_rad
        self._inputs = inputs or make_prompt_inputs(len(scenario.names))
        setups = [scenario.setup(name) for name in scenario.names]
        self._hands: dict[int, HandActor] = {}
        if inputs is None:
            self._meet_hands({**make_hand_players(scenario), **hands}, setups)
        changes = self._inputs.changes
        self._tables = stack_site_arrays(
            setups, len(changes), self._inputs.longest_us, self._inputs.late_ns
        )
        self._changes = deque(changes)
        self._layouts = [setup.layout for setup in setups]
        self._plug_laws(setups)
        joints = max(max(layout.joints, layout.shared) for layout in self._layouts)
        count = len(scenario.names)
        self._progress: RowArray = np.zeros(count, PROGRESS_DTYPE)
        self._progress["rate_hz"] = [scenario.sites[name].rate_hz for name in scenario.names]
        self._progress["apart_ns"] = self._progress["diverged_ns"] = -1
        self._taken = np.zeros((count, count - 1), dtype=np.int64)
        late_ticks = self._inputs.late_ns * int(self._progress["rate_hz"].max()) // NS_PER_S + 2
        kept = 1 << max(_largest_ratio(scenario) + 1, keep, late_ticks).bit_length()
        floats = max(layout.floats for layout in self._layouts)
        self._sent = KeptRecords(
            np.zeros((count, kept), dtype=np.int64), np.zeros((count, kept, floats))
        )
        self._peaks = np.full((count, 0, 3 * joints), -1.0)
        self._sums: RowArray = np.zeros(count, sums_dtype(joints))
        self._sums["first_environment"] = [
            len(spec.hands) if spec.environment else -1 for spec in scenario.sites.values()
        ]
        self._taken_ticks = [0] * count
        self._plants = {
            i: plants[name] for i, name in enumerate(scenario.names) if name in plants
        }
        self._torques = {i: self._layouts[i].columns()["tau"] for i in self._plants}
        self._acted = dict[int, int]()
        self._moved = dict.fromkeys(self._plants, 0)
        self._selected: dict[int, SiteArrays] = {}
        self.ran_s = 0.0

    def _meet_hands(self, hands: Mapping[str, HandActor], setups: Sequence[SiteSetup]) -> None:
        """Makes room for what hands do, of every tick; each is asked at ticks of its own."""
        self._hands = {
            i: hands[setup.name] for i, setup in enumerate(setups) if setup.name in hands
        }
        if self._hands:
            rows = [
                _find_live_row(setup) if i in self._hands else -1
                for i, setup in enumerate(setups)
            ]
            size = max((setups[i].layout.hand - 3) // 2 for i in self._hands)
            acts = np.zeros((len(setups), 0, 1 + 2 * size))
            feed = self._inputs.feed._replace(hands=acts, hand_rows=np.array(rows))
            self._inputs = self._inputs._replace(feed=feed)

    def _plug_laws(self, setups: Sequence[SiteSetup]) -> None:
        tables = self._tables
        count = len(setups)
        self._laws: dict[int, PlainLaw | CompiledLaw] = {}
        self._law_arrays: LawArrays | None = None
        if tables.channel is None:
            return
        sent = np.zeros((count, max(setup.channel.record_size for setup in setups)))
        for i, setup in enumerate(setups):
            if setup.own is not None:
                own = select_site(tables, i, setup.layout)
                law = setup.own(setup.law_context())
                self._laws[i] = plug_law(law, setup, own, sent[i, : setup.channel.record_size])
        compiled = {i: law for i, law in self._laws.items() if isinstance(law, CompiledLaw)}
        addresses = np.zeros(count, dtype=np.int64)
        rows = np.zeros((count, max((len(one.row) for one in compiled.values()), default=0)))
        for i, one in compiled.items():
            rows[i, : len(one.row)] = one.row
            one.row = rows[i]
            addresses[i] = one.address
        self._law_arrays = LawArrays(addresses, rows, sent)

    def step_to(self, last_ns: int) -> None:
        """Makes the planned ticks up to a time, ns since the epoch, and takes in the changes
        before it.

        A diverged run stays as it is.

        Raises:
            LawFailed: a plugged law failed.
        """
        rates_hz = [int(progress["rate_hz"]) for progress in self._progress]
        while self._changes and self.diverged_s is None:
            tick, i, change = self._changes[0]
            t_ns = tick_ns(tick, rates_hz[i])
            if t_ns > last_ns:
                break
            self._step_until(t_ns - 1)
            take_change(self.arrays(i), change, t_ns)
            self._changes.popleft()
        if self.diverged_s is None:
            self._step_until(last_ns)

    def _step_until(self, last_ns: int) -> None:
        """Steps every site up to a time, in pieces within which no hand is asked and no plant
        moves.
        """
        while self.has_programs and self.diverged_s is None:
            asked_ns = [*map(self._let_act, self._hands), *map(self._let_move, self._plants)]
            if min(asked_ns) > last_ns:
                break
            self._step_piece(min(asked_ns) - 1)
        self._step_piece(last_ns)
        for i in self._plants:
            self._let_move(i)

    def _let_move(self, i: int) -> int:
        """Lets the plant of a site move on to the site's next tick; returns the time of the one
        after, ns.
        """
        k = int(self._progress[i]["tick"])
        plant = self._plants[i]
        own = self.arrays(i).site[0]
        if k > self._moved[i]:
            plant.move(k - 1, self._last_row(i)[self._torques[i]].tolist())
        self._moved[i] = k
        n = self._layouts[i].joints
        own["q"][:n] = plant.state.q
        own["qd"][:n] = plant.state.qd
        own["sensed"][:n] = [-torque for torque in plant.state.tau_x] or 0.0
        return (
            NEVER_NS if self._progress[i]["t_ns"] == NEVER_NS else tick_ns(k + 1, plant.rate_hz)
        )

    def _let_act(self, i: int) -> int:
        """Lets the hand of a site act at the ticks before it is asked again; returns the time
        of that, ns.
        """
        progress = self._progress[i]
        hand = self._hands[i]
        acts = self._inputs.feed.hands
        k = int(progress["tick"])
        rate_hz = int(progress["rate_hz"])
        if progress["t_ns"] == NEVER_NS:
            return NEVER_NS
        if k < self._acted.get(i, 0):
            return tick_ns(self._acted[i], rate_hz)
        block = hand.compute_actions(k, int(progress["ticks"]), self.arrays(i))
        _write_actions(acts[i], k, block)
        self._acted[i] = k + len(block)
        return tick_ns(self._acted[i], rate_hz)

    def _step_piece(self, last_ns: int) -> None:
        rows = (
            self._progress,
            self._taken,
            self._sent,
            self._inputs.feed,
            self._peaks,
            self._sums,
        )
        compiled = [law for law in self._laws.values() if isinstance(law, CompiledLaw)]
        try:
            if len(compiled) < len(self._laws):
                self._run_plain_until(last_ns)
            else:
                run_until(
                    last_ns,
                    self._settled_rad,
                    *rows,
                    self._tables,
                    self._tables.chain,
                    self._law_arrays,
                )
        except LawFailed:
            raise
        except Exception as error:  # whatever a compiled law raises
            found = [law.find_failure(error) for law in compiled]
            raise next(filter(None, found), error) from None

    def _run_plain_until(self, last_ns: int) -> None:
        """Does as `run_until`, and asks laws in plain Python between the stages."""
        kept = (self._peaks, self._sums)
        tables = self._tables
        laws = self._law_arrays
        asked = (self._progress, self._taken, self._sent, self._inputs.feed)
        progress = self._progress
        while (t_ns := int(progress["t_ns"].min())) <= last_ns and t_ns != NEVER_NS:
            for i in np.flatnonzero(progress["t_ns"] == t_ns).tolist():
                own = self.arrays(i)
                sense_site(i, *asked, tables, own.chain)
                if isinstance(law := self._laws.get(i), PlainLaw):
                    law.compute(int(progress[i]["tick"]), t_ns)
                finishing = (progress, self._sent, *kept, tables, own.chain, laws)
                if finish_site(i, self._settled_rad, *finishing) == Mode.DIVERGED:
                    progress[i]["diverged_ns"] = last_ns = t_ns

    def advance_to(self, until_s: float) -> None:
        """Continues the run to the end of a scenario of `until_s` seconds; a diverged run stays
        as it is.
        """
        if until_s <= self.ran_s or self.diverged_s is not None:
            return
        rates_hz = self._progress["rate_hz"].tolist()
        self.plan([max(1, round(until_s * rate_hz)) for rate_hz in rates_hz])
        self.step_to(round(until_s * NS_PER_S))
        self.ran_s = until_s if self.diverged_s is None else self.diverged_s

    def plan(self, ticks: Sequence[int]) -> None:
        """Lets each site make so many ticks in all."""
        progress: Row
        for progress, count in zip(self._progress, ticks, strict=True):
            progress.ticks = count
            if progress.tick < count:
                progress.t_ns = tick_ns(progress.tick, progress.rate_hz)
        most_s = max(
            count / rate for count, rate in zip(ticks, self._progress["rate_hz"], strict=True)
        )
        grown = np.full(
            (len(ticks), math.ceil(most_s * BUCKETS_PER_S) + 1, self._peaks.shape[2]), -1.0
        )
        grown[:, : self._peaks.shape[1]] = self._peaks
        self._peaks = grown
        if self._hands:
            feed = self._inputs.feed
            acts = np.zeros((len(ticks), max(ticks), feed.hands.shape[2]))
            acts[:, : feed.hands.shape[1]] = feed.hands
            self._inputs = self._inputs._replace(feed=feed._replace(hands=acts))

    @cached_property
    def _state(self) -> RunState:
        laws = self._law_arrays
        arrays = self._tables
        held = [self._progress, self._taken, *self._sent, self._sums]
        held += [array for array in arrays if isinstance(array, np.ndarray)]
        held += [] if arrays.channel is None else [*arrays.channel]
        return RunState([*held, *([] if laws is None else [laws.rows, laws.sent])])

    @property
    def has_programs(self) -> bool:
        """True if hands or plants of one's own act in it."""
        return bool(self._hands or self._plants)

    def copy_state(self, other: "FusedRun") -> None:
        """Becomes equal to another run of the same scenario, which is planned alike."""
        self.scale_difference(other, 0.0)

    def scale_difference(self, other: "FusedRun", factor: float) -> None:
        """Becomes another run plus so much of its difference to that, whose records it has made
        by now.

        A run that has programs cannot.
        """
        assert not self.has_programs
        self._state.scale_difference(other._state, factor)
        self._changes = deque(other._changes)
        self._taken_ticks = list(other._taken_ticks)
        for i, law in self._laws.items():
            if isinstance(law, PlainLaw):
                own = np.array(law.memory)
                its = np.array(other._laws[i].memory)
                law.restore((its + factor * (own - its)).tolist())

    def arrays(self, i: int) -> SiteArrays:
        """Returns what a site is made of, as its next tick will find it; to be read, not
        written.
        """
        if i not in self._selected:
            self._selected[i] = select_site(self._tables, i, self._layouts[i])
        return self._selected[i]

    def displace(self, field: str, by: Array) -> None:
        """Adds to a field of every site's state, shape (N, n)."""
        self._tables.site[field][:, 0, : by.shape[1]] += by

    def measure_distance(self, other: "FusedRun", field: str) -> float:
        """Returns by how much a field of the sites' state differs at the most."""
        return float(np.abs(self._tables.site[field] - other._tables.site[field]).max())

    def run_and_sample(self, until_s: float) -> tuple[Array, Array]:
        """Continues the run; returns q, (100, N, n), rad, and theta_hat, (100, N, P), of its
        last quarter.
        """
        found = []
        for t_s in np.linspace(0.75 * until_s, until_s, 100):
            self.advance_to(float(t_s))
            found.append((self.q, self.theta_hat))
        q, theta_hat = map(np.array, zip(*found, strict=True))
        return q, theta_hat

    @property
    def diverged_s(self) -> float | None:
        """Time at which the first site left its limits, s, or None."""
        ends = [int(at) for at in self._progress["diverged_ns"] if at >= 0]
        return min(ends) / NS_PER_S if ends else None

    @property
    def settled_s(self) -> float | None:
        """Time from which on every |e| is below `settled_rad`, s; None if one is not at the end."""
        last = max(range(len(self._progress)), key=lambda n: int(self._progress[n]["apart_ns"]))
        progress: Row = self._progress[last]
        if progress.apart_ns < 0:
            return 0.0
        ended = progress.apart_ns == tick_ns(progress.tick - 1, progress.rate_hz)
        return None if ended else float(progress.apart_ns) / NS_PER_S

    @property
    def buckets(self) -> tuple[Array, ...]:
        """The peaks of every 50 ms of each site, see `run_until`, shape (buckets, 3 n) each.

        -1 marks a bucket without a record of that site; the last one may be incomplete.
        """
        return tuple(
            self._peaks[
                n, : (int(progress["tick"]) - 1) * BUCKETS_PER_S // int(progress["rate_hz"]) + 1
            ]
            for n, progress in enumerate(self._progress)
        )

    @property
    def maxima(self) -> tuple[Array, ...]:
        """Largest |e|, rad, and |qd|, rad/s, of any joint, of the same buckets, shape (buckets,
        2) each.
        """
        return tuple(map(largest_of_joints, self.buckets))

    @property
    def totals(self) -> RunTotals:
        """Errors, effort and contact over the whole run."""
        ticks = self._progress["tick"].astype(np.float64)
        specs = self._scenario.sites.values()
        touched = any(isinstance(one, Wall) for spec in specs for one in spec.environment)
        return RunTotals(
            rms_error_rad=float(np.sqrt(self._sums["errors"] / ticks[:, None]).max()),
            effort_nm=float(
                np.sqrt(
                    np.mean(self._sums["effort"] / (self._tables.site["joints"][:, 0] * ticks))
                )
            ),
            force_peak_n=float(self._sums["force_peak_n"].max()) if touched else None,
            walls_j=float(self._sums["environment_j"].sum())
            if (self._sums["first_environment"] >= 0).any()
            else None,
        )

    @property
    def q(self) -> Array:
        """Joint angles after the last tick, shape (N, n), rad."""
        return np.array(self._tables.site["q"][:, 0])

    @property
    def theta_hat(self) -> Array:
        """Estimates after the last tick, shape (N, P)."""
        return np.array(self._tables.site["theta_hat"][:, 0])

    @property
    def memories(self) -> list[Array]:
        """What the laws of sites remember after the last tick; of one that is not plugged in
        nothing.
        """
        laws = [self._laws.get(i) for i in range(len(self._progress))]
        return [np.array([] if law is None else law.memory, dtype=np.float64) for law in laws]

    @property
    def tau_x(self) -> list[Array]:
        """The exogenous torque of each site's last record, shape (n,) each, N m."""
        return [
            row[layout.columns()["tau_x"]]
            for row, layout in zip(self.records, self._layouts, strict=True)
        ]

    def pop_records(self) -> list[tuple[IntArray, Array]]:
        """Returns of each site the records since the last call, as far as they are kept: t, ns,
        and a row.
        """
        found = []
        for n, progress in enumerate(self._progress):
            pages = self._sent.t_ns.shape[1]
            first = max(self._taken_ticks[n], int(progress["tick"]) - pages)
            at = np.arange(first, int(progress["tick"])) % pages
            floats = self._layouts[n].floats
            found.append((self._sent.t_ns[n, at], self._sent.rows[n, at, :floats]))
            self._taken_ticks[n] = int(progress["tick"])
        return found

    @property
    def records(self) -> Array:
        """Last record of each site, floats as in `Layout.columns`, a row per site."""
        return np.array([self._last_row(n) for n in range(len(self._progress))])

    def _last_row(self, n: int) -> Array:
        row: Array = self._sent.rows[
            n, (int(self._progress[n]["tick"]) - 1) % self._sent.t_ns.shape[1]
        ]
        return row


def explain_not_repeatable(log: Log, *, own_laws: bool = False) -> str:
    """Returns why a run cannot be executed again from its log alone; "" if it can.

    Args:
        log: the log.
        own_laws: whether code of laws from outside may run.
    """
    scenario = log.scenario
    if scenario.external:
        arms = ", ".join(sorted(scenario.external))
        return f"how the arm of {arms}, outside of the program, would have replied is not known"
    if find_user_laws(scenario) and not own_laws:
        return "laws from outside may not run (--law FILE)"
    if set(log.executed_sites) != set(log.sites):
        return "sites that a rerun took over did not react"
    for name in log.sites:
        part = log[name]
        if not len(part) or not np.array_equal(part.tick, np.arange(len(part))):
            return f"records of {name} are missing"
    return ""


def read_run_inputs(log: Log) -> RunInputs:
    """Returns the inputs of a run that can be executed again, see `explain_not_repeatable`.

    Raises:
        LogError: the log names a change that is none.
    """
    ticks = max(len(log[name]) for name in log.sites)
    listed = [
        (tick * NS_PER_S // log[name].rate_hz, (tick, i, change))
        for i, name in enumerate(log.scenario.names)
        for tick, taken in log.commands(name).items()
        for change in taken
    ]
    changes = [one for _, one in sorted(listed, key=lambda timed: timed[0])]
    models = [change.model for _, _, change in changes if change.model is not None]
    longest_us = max_delay_us(models, [None] * len(models)) if models else 0
    feed = make_prompt_inputs(len(log.scenario.names)).feed
    late_ns = 0
    if log.driver != "virtual":
        first, samples, late_ns = _list_arrivals(log, ticks)
        feed = feed._replace(first=first, samples=samples)
    return RunInputs(_add_hands(feed, log, ticks), changes, late_ns, longest_us)


def _list_arrivals(log: Log, ticks: int) -> tuple[IntArray, IntArray, int]:
    """Returns arrivals as a feed has them, and by how much the latest came after its stamp, ns."""
    names = log.scenario.names
    first = np.zeros((len(names), max(len(names) - 1, 1), ticks + 1), dtype=np.int64)
    listed: list[IntArray] = []
    total = late_ns = 0
    for i, part in enumerate(map(log.__getitem__, names)):
        counts, rows = part.arrivals
        came = np.repeat(part.tick, counts)
        for p, peer in enumerate(part.peers):
            known = (rows[:, 0] == p) & (rows[:, 1] >= 0) & (rows[:, 1] <= log[peer].last_tick)
            sent = rows[known, 1]
            stamps_ns = rows[known, 1] * NS_PER_S // log[peer].rate_hz
            at = np.maximum(came[known], -(-(stamps_ns + 1) * part.rate_hz // NS_PER_S))
            order = np.argsort(at, kind="stable")
            first[i, p] = total + np.searchsorted(at[order], np.arange(ticks + 1))
            listed.append(sent[order])
            total += len(sent)
            late_ns = max(
                late_ns, int((at * NS_PER_S // part.rate_hz - stamps_ns).max(initial=0))
            )
    return first, np.concatenate([*listed, np.zeros(0, np.int64)]), late_ns


def _add_hands(feed: RecordedFeed, log: Log, ticks: int) -> RecordedFeed:
    setups = [log.scenario.setup(name)._replace(own=None) for name in log.scenario.names]
    rows = list(map(_find_live_row, setups))
    if max(rows) < 0:
        return feed
    size = max((setup.layout.hand - 3) // 2 for setup in setups)
    hands = np.zeros((len(setups), ticks, 1 + 2 * size))
    for i, name in enumerate(log.scenario.names):
        if rows[i] >= 0:
            _write_actions(hands[i], 0, log[name].hand)
    return feed._replace(hands=hands, hand_rows=np.array(rows))


def _write_actions(acts: Array, k: int, block: Array) -> None:
    """Writes what a hand does from tick k on, a row as `HandInForce`, as a feed has it."""
    own = (block.shape[1] - 3) // 2
    size = (acts.shape[1] - 1) // 2
    target = block[:, 3 : 3 + own]
    part = acts[k : k + len(block)]
    part[:, 0] = block[:, 0]
    part[:, 1 : 1 + own] = target
    part[:, 1 + size : 1 + size + own] = target + block[:, 3 + own :]


def _find_live_row(setup: SiteSetup) -> int:
    """Returns which of a site's torque sources is its live hand; -1: it has none."""
    return next((n for n, one in enumerate(setup.actors) if one.kind in LIVE_KINDS), -1)
