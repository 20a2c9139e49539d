"""How a site takes part in a session."""

from dataclasses import dataclass

from trilat_net.net.connection import Connection


@dataclass(frozen=True, slots=True)
class Options:
    """How a site takes part.

    Attributes:
        session: the session's name.
        connection: how it takes part in the network.
        join_timeout_s: how long to wait for the others, s.
        needs_recorder: whether a recorder must be there.
        cpu: the processor to stay on, or None.
        stay_s: how long to stay afterwards, until the recorder has left, s at most.
        clock_offset_s: injected: how far the clock is ahead of the machine's, s.
        clock_drift_ppm: injected: by how much it runs faster, ppm.
    """

    session: str
    connection: Connection
    join_timeout_s: float = 60.0
    needs_recorder: bool = False
    cpu: int | None = None
    stay_s: float = 0.0
    clock_offset_s: float = 0.0
    clock_drift_ppm: float = 0.0
