"""Simulates an experiment about 1000 times faster than real time, without writing a log.

All arms of the experiment are simulated in one compiled loop. Instead of storing every tick,
the loop stores maxima over intervals of 50 ms, and sums over the run. Parameter sweeps use this
module. It is also used to repeat runs with a small disturbance, which shows whether they are
stable. Studies that need the records of some runs get them from `FusedRun.simulate_log`, as a
log that is never encoded.

Invariant:
    - The results are bit-identical to those of `execution.virtual` with its default network.
      Scenarios that the compiled loop cannot execute are rejected.
    - A run with the inputs from a log (received samples and applied changes) is bit-identical
      to the recorded run. Because the clocks of two computers may differ, a received sample may
      carry a time stamp in the future. It is then delivered in the first tick after the stamp,
      since a site does not use it earlier.
"""

import math
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np

from ..core import (
    MAX_ARRIVALS,
    Array,
    CompiledRun,
    CoreChange,
    IntArray,
    LinkSchedule,
    RunInputs,
)
from ..errors import ScenarioError, count_nouns
from ..log import Log, UnwrittenLog
from ..records import NS_PER_S
from ..scenario import HandPlayer, PlantPlayer, Scenario

_BLOCK_TICKS = 4096
"""Interval at which the records of `FusedRun.simulate_log` are copied, in ticks of the fastest
site.
"""


def _find_largest_ratio(scenario: Scenario) -> int:
    """Returns the ratio of the largest to the smallest tick rate, rounded up."""
    rates_hz = [spec.rate_hz for spec in scenario.sites.values()]
    return math.ceil(max(rates_hz) / min(rates_hz))


class FusedRun(CompiledRun):
    """Simulates all arms of a scenario in one compiled loop.

    See `CompiledRun` for the programs that are called in addition to the loop.

    Args:
        scenario: The scenario.
        settled_rad: A site counts as settled while |e| of all joints is below this limit, in
            rad.
        keep: Number of most recent records per site that are kept for `pop_records`.
        inputs: Inputs of a recorded run that is repeated. The scenario's programs then do not
            act as operators, because their actions are part of the inputs.
        hands: Mapping from site to live operator. These operators replace the programs named in
            the scenario.
        runs_plants: If True, users' programs move the external arms for which the scenario
            names such a program. Otherwise, a scenario with an external arm is rejected.

    Attributes:
        scenario: The scenario.
        plants: Mapping from site name to the program that moves its arm.

    Raises:
        CodeWithheld: The class of a program is not allowed to run.
        ScenarioError: The loop cannot execute the scenario, see `check_scenario`, or a law
            cannot be created.
    """

    def __init__(
        self,
        scenario: Scenario,
        settled_rad: float = 0.01,
        keep: int = 0,
        inputs: RunInputs | None = None,
        hands: Mapping[str, HandPlayer] = {},
        runs_plants: bool = False,
    ) -> None:
        plants = PlantPlayer.make_all(scenario) if runs_plants else {}
        self.check_scenario(scenario, plants)
        names = scenario.names
        setups = [scenario.setup(name) for name in names]
        live_hands: Mapping[str, HandPlayer] = {}
        if inputs is None:
            live_hands = {**HandPlayer.make_all(scenario), **hands}
        # The torque sources of a site are its operators, followed by its environment.
        first_environments = [
            len(spec.hands) if spec.environment else -1 for spec in scenario.sites.values()
        ]
        super().__init__(
            setups,
            first_environments=first_environments,
            duration_s=scenario.duration_s,
            settled_rad=settled_rad,
            keep=keep,
            inputs=inputs,
            hands={i: live_hands[name] for i, name in enumerate(names) if name in live_hands},
            plants={i: plants[name] for i, name in enumerate(names) if name in plants},
        )
        self.scenario = scenario
        self.plants = plants

    @staticmethod
    def check_scenario(scenario: Scenario, plants: Collection[str] = ()) -> None:
        """Raises ScenarioError if the compiled loop cannot execute a scenario.

        The loop cannot control a real robot. It computes the motion of each arm itself, unless
        the caller provides a user's program that computes the motion of this arm.

        Args:
            scenario: The scenario.
            plants: Names of the sites for which the caller provides a program that computes the
                motion of the arm.

        Raises:
            ScenarioError: An arm of a site that is not in `plants` is external, or the tick
                rates differ so much that too many samples would arrive in one tick of the
                slowest site.
        """
        scenario.refuse_external_arms(plants)
        ratio = _find_largest_ratio(scenario)
        if ratio > MAX_ARRIVALS:
            raise ScenarioError(
                f"the fastest site executes {count_nouns(ratio, 'tick')} within one tick of "
                f"the slowest, but at most {MAX_ARRIVALS} samples can arrive in a tick; choose "
                "tick rates that differ less",
                path="rate_hz",
                source=scenario.name,
            )

    @classmethod
    def simulate_log(cls, scenario: Scenario) -> Log:
        """Simulates an experiment, and returns a log whose records are stored in columns.

        There is one column per computed quantity: times, modes, motions, torques, estimates,
        sent values, and the samples in use. The columns are bit-identical to those of
        `SimulatedLog`, which executes each tick in Python and writes a message for it. A
        `SimulatedLog` is returned if these columns do not describe the run completely (see
        `_is_described_by_columns`), or if the run ends early.

        Args:
            scenario: The scenario.

        Raises:
            ScenarioError: The scenario cannot run in virtual time.
            LawFailed: A user's control law failed.
        """
        from .virtual import SimulatedLog  # takes time: it loads the writer of logs

        if not _is_described_by_columns(scenario):
            return SimulatedLog(scenario)
        run = cls(scenario, keep=_BLOCK_TICKS + 1)
        blocks: dict[str, list[Array]] = {name: [] for name in scenario.names}
        for batch in run.iterate_batches():
            for name, (_, rows) in zip(scenario.names, batch, strict=True):
                blocks[name].append(rows)
        if run.diverged_s is not None:
            return SimulatedLog(scenario)

        columns = {}
        for i, name in enumerate(scenario.names):
            rows = np.concatenate(blocks[name])
            used = run.read_samples_in_use(i, len(rows))
            ticks = np.arange(len(rows), dtype=np.int64)
            site_columns: dict[str, Any] = {
                "mode": np.full(len(rows), "run", dtype=object),
                "t_ns": ticks * NS_PER_S // scenario.sites[name].rate_hz,
                "used": dict(zip(scenario.peers(name), used.T, strict=True)),
            }
            for field, column_range in scenario.layout(name).columns().items():
                site_columns[field] = rows[:, column_range]
            columns[name] = site_columns
        return UnwrittenLog(scenario, columns)

    @staticmethod
    def explain_not_repeatable(log: Log, *, own_laws: bool = False) -> str:
        """Explains why the compiled loop cannot repeat a run exactly from its log alone.

        For example, records may be missing from the log, or a control law may be code that is
        not allowed to run on this machine.

        Args:
            log: Log of the run.
            own_laws: True if control laws written by users are allowed to run.

        Returns:
            The reason, for the user, or an empty string if the run can be repeated.
        """
        scenario = log.scenario
        if scenario.external:
            arms = ", ".join(sorted(scenario.external))
            return f"the reaction of the external arm of {arms} is not known"
        if scenario.user_laws and not own_laws:
            return (
                "the imported control laws may not run (permit them with --law FILE, in Python "
                "with own_laws=True)"
            )
        if set(log.executed_sites) != set(log.sites):
            return "in a rerun, the sites whose records were copied did not react"
        for name in log.sites:
            part = log[name]
            if not len(part) or not np.array_equal(part.tick, np.arange(len(part))):
                return f"records of {name} are missing"
        return ""

    @staticmethod
    def read_inputs(log: Log) -> RunInputs:
        """Reads from a log everything that is needed to repeat its run.

        The inputs are the ticks in which samples from other sites arrived, the changes to
        settings, and the actions of live operators (people or programs that moved an arm). The
        run must be repeatable, see `explain_not_repeatable`.

        Args:
            log: Log of the run.

        Returns:
            The inputs, for the argument `inputs` of this class.

        Raises:
            LogError: The log contains an entry that is not a valid change of the scenario.
        """
        names = log.scenario.names
        ticks = max(len(log[name]) for name in log.sites)
        inputs = RunInputs.prompt(len(names))._replace(changes=_read_changes(log))
        # In a log of virtual time, all samples arrived at once.
        if log.driver != "virtual":
            first_arrivals, sample_ticks, late_ns = _read_arrivals(log, ticks)
            feed = inputs.feed._replace(first=first_arrivals, samples=sample_ticks)
            inputs = inputs._replace(feed=feed, late_ns=late_ns)

        setups = [log.scenario.setup(name) for name in names]
        sites = [i for i, setup in enumerate(setups) if setup.live_actor >= 0]
        inputs = inputs.with_hands(setups, sites, ticks)
        for i in sites:
            inputs.write_actions(i, 0, log[names[i]].hand)
        return inputs


def _read_changes(log: Log) -> list[tuple[int, int, CoreChange]]:
    """Returns the changes of all sites in order of time, in the format of `RunInputs`."""
    timed_changes = []
    for i, name in enumerate(log.scenario.names):
        rate_hz = log[name].rate_hz
        for tick, changes in log.commands(name).items():
            t_ns = tick * NS_PER_S // rate_hz
            timed_changes += [(t_ns, (tick, i, change)) for change in changes]
    timed_changes.sort(key=lambda timed: timed[0])
    return [change for _, change in timed_changes]


def _read_arrivals(log: Log, ticks: int) -> tuple[IntArray, IntArray, int]:
    """Returns the arrivals from a log, in the format of `ReplayedInputs`.

    For each site and peer, the samples are sorted by the tick in which they are delivered. An
    index gives, for each tick, the first sample in this list that is delivered in it.

    Args:
        log: The log.
        ticks: Largest number of ticks of any site.

    Returns:
        The index (`first`), the ticks of the samples (`samples`), and the largest time from the
        stamp of a sample to its arrival, in ns.
    """
    names = log.scenario.names
    most_peers = max(len(names) - 1, 1)
    first = np.zeros((len(names), most_peers, ticks + 1), dtype=np.int64)
    samples: list[IntArray] = []
    total = 0
    late_ns = 0
    for i, name in enumerate(names):
        part = log[name]
        counts, rows = part.arrivals
        arrival_ticks = np.repeat(part.tick, counts)
        senders = rows[:, 0]
        sent_ticks = rows[:, 1]
        for j, peer in enumerate(part.peers):
            is_known = (sent_ticks >= 0) & (sent_ticks <= log[peer].last_tick)
            selected = (senders == j) & is_known
            sample_ticks = sent_ticks[selected]
            stamps_ns = sample_ticks * NS_PER_S // log[peer].rate_hz
            # A sample is not used before the first tick after its stamp (L2).
            earliest = LinkSchedule.first_ticks(stamps_ns + 1, part.rate_hz)
            delivery_ticks = np.maximum(arrival_ticks[selected], earliest)
            order = np.argsort(delivery_ticks, kind="stable")
            starts = np.searchsorted(delivery_ticks[order], np.arange(ticks + 1))
            first[i, j] = total + starts
            samples.append(sample_ticks[order])
            total += len(sample_ticks)
            deliveries_ns = delivery_ticks * NS_PER_S // part.rate_hz
            ages_ns = deliveries_ns - stamps_ns
            late_ns = max(late_ns, int(ages_ns.max(initial=0)))
    return first, np.concatenate([*samples, np.zeros(0, np.int64)]), late_ns


def _is_described_by_columns(scenario: Scenario) -> bool:
    """Returns True if the arrays computed by the simulation describe a run completely.

    Some information exists only in a written log: changes to settings, the actions of live
    operators, the motion of objects in an environment, and the modes of a site that reacts to
    missing samples.

    Args:
        scenario: The scenario.
    """
    if scenario.timeline or any(link.outages_s for link in scenario.links.values()):
        return False
    for name, site in scenario.sites.items():
        lengths = scenario.layout(name).lengths()
        if lengths.get("hand") or lengths.get("bodies") or site.on_stale.action != "use":
            return False
    return True
