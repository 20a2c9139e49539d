"""The live driver: a fixed-rate loop on an absolute grid.

Law (L1): tick k lies at epoch + k periods of the session's grid, which is the leader's. Lateness is telemetry
and enters no formula; a late loop runs its missed ticks back to back and counts them.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from trilat_net.core.grid import NS_PER_S
from trilat_net.core.site import Site
from trilat_net.core.tick import Command, Measured, Mode, Output, Tick
from trilat_net.errors import LawFailed
from trilat_net.net.clock import Clock
from trilat_net.net.stats import LoopStats
from trilat_net.net.timing import Timing
from trilat_net.net.wire import encode, encode_state

from .intake import Intake


@dataclass(slots=True)
class Ports:
    """What the loop touches besides its site.

    Attributes:
        clock: the time.
        intake: the peers' samples.
        timing: when ticks are due, and what the stamps say.
        publish_state: publishes a record.
        publish_link: publishes statistics.
        slack: called ten times a second, after the tick's work is done, with the tick and its nominal time.
        stopped: True once the loop was asked to end.
        commands: what the site is ordered at a tick.
        news: called after a tick that took a command in, or at which the mode changed.
        spare: called after a tick that left a quarter of its period.
        measured: what an arm outside of the program was measured to do, at this instant.
        step: steps the site; by default the site's own.
        failed: is told of a law from outside that failed; the loop ends then.
    """

    clock: Clock
    intake: Intake
    timing: Timing
    publish_state: Callable[[bytes], None]
    publish_link: Callable[[bytes], None]
    slack: Callable[[int, int], None]
    stopped: Callable[[], bool]
    commands: Callable[[int], Sequence[Command]] = lambda _: ()
    news: Callable[[Output], None] = lambda _: None
    spare: Callable[[], object] = lambda: None
    measured: Callable[[], Measured | None] = lambda: None
    step: Callable[[Tick], Output] | None = None
    failed: Callable[[LawFailed], None] | None = None


def run_loop(site: Site, boot: int, ticks: int, stats: LoopStats, ports: Ports) -> Output | None:
    """Runs a site in real time, from tick 0, and returns its last record.

    Args:
        site: the site, at its start.
        boot: this process's boot.
        ticks: how many ticks to make.
        stats: where the loop is accounted for.
        ports: what the loop touches.

    Returns:
        The last record: its mode says whether the run stayed within its limits. None if it made no tick.

    Raises:
        LawFailed: a law from outside did, and nobody wants to be told.
    """
    clock, intake, timing = ports.clock, ports.intake, ports.timing
    step = ports.step or site.step
    quarter_ns = NS_PER_S // (4 * site.rate_hz)
    busy_us = 0
    mode = Mode.RUN
    output = None
    for k in range(ticks):
        deadline_ns = timing.grid.deadline(k)
        clock.sleep_until(deadline_ns)
        if ports.stopped():
            break
        woke_ns = clock.monotonic_ns()
        late_us = max(0, (woke_ns - deadline_ns) // 1000)
        arrivals = intake.drain(k * NS_PER_S // site.rate_hz + woke_ns - deadline_ns)
        try:
            output = step(Tick(k, arrivals, ports.commands(k), ports.measured()))
        except LawFailed as failed:  # of this tick there is no record
            if ports.failed is None:
                raise
            ports.failed(failed)
            break
        sent_ns, echo = timing.sent(k, clock.monotonic_ns()), timing.echo()
        ports.publish_state(
            encode_state(site.name, boot, site.peers, output, arrivals, late_us, busy_us, sent_ns, echo)
        )
        stats.tick(late_us, busy_us)
        if stats.due(k):
            ports.publish_link(encode(stats.take(output, timing.measured(woke_ns))))
            ports.slack(k, output.t_ns)
        if output.mode is Mode.DIVERGED:
            break
        if output.cmd or output.mode is not mode:
            mode = output.mode
            ports.news(output)
        if timing.grid.deadline(k + 1) - clock.monotonic_ns() > quarter_ns:
            ports.spare()
        busy_us = (clock.monotonic_ns() - woke_ns) // 1000
    return output
