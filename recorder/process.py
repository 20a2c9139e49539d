"""The recorder as one process: from its arguments to its exit code."""

from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import replace

from trilat_net import collector
from trilat_net.errors import RunFailed
from trilat_net.interrupt import Interrupt
from trilat_net.log.parts import Storage
from trilat_net.net.clock import Clock
from trilat_net.net.connection import Connection, open_bus
from trilat_net.net.voice import new_boot

from .discovery import Discovery
from .recorder import Recorder


def record_session(
    session: str,
    storage: Storage,
    connection: Connection,
    join_timeout_s: float | None,
    clock: Clock,
    say: Callable[[str], None],
    afterwards: Callable[[], None] = lambda: None,
) -> int:
    """Records one session, as a process of its own.

    Args:
        session: the session's name.
        storage: where the log goes.
        connection: how it takes part in the network; without endpoints to connect to it asks the session's
            first site, on this machine.
        join_timeout_s: how long to wait for the session to begin, s, or None.
        clock: the time.
        say: tells a person what happens.
        afterwards: what to do with the finished log of a session that nobody interrupted. The recorder is a
            member of the session until that is done: sites that shall stay wait for it.

    Returns:
        The exit code: 0, or 128 and the number of the signal that ended it.

    Raises:
        TrilatError: the session did not begin, the file cannot be written, or records are missing.
    """
    boot = new_boot()
    say(f"recorder: waiting for session {session!r} to begin")
    with ExitStack() as stack:
        interrupt = stack.enter_context(Interrupt())
        if connection.connect is None:
            discovery = Discovery(session, boot, connection.own)
            stack.callback(discovery.close)
            found = discovery.endpoints(clock, interrupt.requested, join_timeout_s)
            connection = replace(connection, connect=found)
        bus = open_bus(
            connection, clock, interrupt.requested, join_timeout_s, lambda text: say(f"recorder: {text}")
        )
        if bus is None:
            return interrupt.exit_code
        stack.callback(bus.close)
        recorder = Recorder(bus, clock, session, boot, storage, interrupt.requested, say)
        collector.settle()  # in a session its pauses would be time that a crash can lose
        epoch = recorder.join(join_timeout_s)
        if epoch is None:
            say("recorder: ended before the session began; nothing was written")
            return interrupt.exit_code
        recording = recorder.record(epoch)
        say("\n".join(recording.summary()))
        if not interrupt.requested():
            with suppress(KeyboardInterrupt), interrupt.raising():
                afterwards()
    if interrupt.requested():
        return interrupt.exit_code
    if problem := recording.problem():
        raise RunFailed(problem)
    return 0
