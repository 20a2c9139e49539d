"""The faults of a session and their times: drawn from a seed, or given.

All faults lie within the trouble of a timetable. The rest of the session must be long enough
for all sites to follow their peers again.
"""

from collections.abc import Callable, Sequence
from random import Random
from typing import NamedTuple

from trilat_net.net.requests import ChangeRequest

SITES = ("m1", "m2", "s")
LATCHES = ("stop", "enable", "reset")
STORM_S = 0.6
"""The length of the longest storm of orders."""
STORM_ORDERS = 150
"""The number of orders in the longest storm."""
MEMBERS = (*SITES, "recorder")
MOST_FAULTS = 4


class Timetable(NamedTuple):
    """Times of the faults in a session; tick 0 is at 0 s.

    Attributes:
        length_s: Length of the session.
        trouble_s: First and last time at which a fault may begin.
        healed_s: Time at which all faults have ended.
        engaged_s: Time before the end at which all sites follow their peers again.
        without: Kinds of faults from which a site would not recover in time.
    """

    length_s: float
    trouble_s: tuple[float, float]
    healed_s: float
    engaged_s: float
    without: tuple[str, ...] = ()


WHOLE = Timetable(5.0, (0.5, 1.6), 1.8, 0.2)
SHORT = Timetable(1.4, (0.4, 0.52), 0.57, 0.05, ("kill", "end", "stop", "storm"))


class ArmSettings(NamedTuple):
    """Settings of the arms; the defaults are those of the matrix.

    Attributes:
        tau_rate_limit_nm_s: Limit of a torque's rate; None without a limit.
        learnt: Share of the true parameters with which the estimates begin.
        qd_limit_rad_s: Limit of the speeds; a limit below the arms' own motion makes a fault.
        start_rad_s: Speed of each joint of every arm at its start, up to that limit.
    """

    tau_rate_limit_nm_s: float | None = 300.0
    learnt: float = 0.0
    qd_limit_rad_s: float = 10.0
    start_rad_s: tuple[float, float] = (0.0, 0.0)


def draw_settings(seed: int) -> ArmSettings:
    rng = Random(f"settings {seed}")
    if rng.random() < 2.0 / 3.0:
        return ArmSettings()
    rate_nm_s = rng.choice([100.0, 100.0 * 10.0 ** rng.random(), None])
    speed_rad_s = rng.choice([10.0, 10.0, round(rng.uniform(0.8, 1.5), 2)])
    learnt = round(rng.random(), 3)
    most_rad_s = speed_rad_s * rng.random()
    start_rad_s = (round(rng.uniform(-most_rad_s, most_rad_s), 3), round(most_rad_s, 3))
    return ArmSettings(rate_nm_s, learnt, speed_rad_s, start_rad_s)


class Fault(NamedTuple):
    """One fault.

    Attributes:
        kind: One of `KINDS`.
        at_s: Time of the fault, s since tick 0.
        for_s: Duration, s.
        of: The affected site, or sender and receiver.
        size: Size, in the unit of the kind.
    """

    kind: str
    at_s: float
    for_s: float
    of: tuple[str, ...]
    size: float = 0.0


def _a_site(rng: Random) -> tuple[str, ...]:
    return (rng.choice(SITES),)


def _a_way(rng: Random) -> tuple[str, ...]:
    return tuple(rng.sample(MEMBERS, 2))


def _what_a_site_sends(rng: Random) -> tuple[str, ...]:
    (site,) = _a_site(rng)
    return site, rng.choice([name for name in MEMBERS if name != site])


def _nobody(_rng: Random) -> tuple[str, ...]:
    return ()


class Kind(NamedTuple):
    """How a kind of fault is drawn: its weight among the kinds, the affected members, and its
    sizes.
    """

    weight: float
    of: Callable[[Random], tuple[str, ...]]
    sizes: tuple[float, float] = (0.0, 0.0)


KINDS = {
    "kill": Kind(2.0, _a_site),  # and start it again
    "end": Kind(1.0, _a_site),  # by SIGTERM, and start it again
    "freeze": Kind(2.0, _a_site),
    "cut": Kind(2.0, _a_way),
    "cut one way": Kind(2.0, _a_way),
    "cut all": Kind(1.0, _nobody),  # a router that dies
    "delay": Kind(1.5, _a_way, (0.001, 0.08)),  # s
    "jitter": Kind(1.5, _a_way, (0.001, 0.06)),  # s
    "loss": Kind(1.5, _a_way, (0.02, 0.9)),
    "duplicate": Kind(1.0, _a_way, (0.05, 1.0)),
    "corrupt": Kind(1.0, _a_way),  # a bit flips, which ends the connection
    "nonsense": Kind(
        1.0, _what_a_site_sends, (0.02, 1.0)
    ),  # a site sends it, with bits that are wrong
    "replay": Kind(1.0, _a_way),  # old messages once more
    "stranger": Kind(1.0, _a_site),  # in the name of a site, of another start
    "wall clock": Kind(1.0, _a_site, (-3600.0, 3600.0)),  # s
    "order": Kind(1.5, _a_site, (0.0, 1.0)),  # somebody changes dominance, or a link
    "stop": Kind(1.5, _a_site),  # by an operator
    "storm": Kind(1.5, _nobody, (0.0, 1.0)),  # of orders to everybody
    "full disk": Kind(0.5, _nobody, (1e5, 2e6)),  # bytes
}


def draw_faults(seed: int, timetable: Timetable = WHOLE) -> list[Fault]:
    rng = Random(seed)
    names = [name for name in KINDS if name not in timetable.without]
    weights = [KINDS[name].weight for name in names]
    faults = []
    for kind in rng.choices(names, weights, k=rng.randint(1, MOST_FAULTS)):
        at_s = round(rng.uniform(*timetable.trouble_s), 4)
        longest_s = timetable.healed_s - at_s
        for_s = round(
            min(longest_s, rng.choice([0.01, 0.03, 0.1, 0.5, 1.5]) * rng.uniform(0.5, 1.5)), 4
        )
        size = round(rng.uniform(*KINDS[kind].sizes), 4)
        faults.append(Fault(kind, at_s, for_s, KINDS[kind].of(rng), size))
    return sorted(faults, key=lambda fault: fault.at_s)


def order_of(fault: Fault) -> tuple[str, ChangeRequest]:
    (site,) = fault.of
    first, second = (name for name in SITES if name != site)
    share = round(0.1 + 0.8 * fault.size, 3)
    if fault.size < 0.5:
        to = {"delay_ms": 20.0 + round(20.0 * fault.size, 1)}
        return site, ChangeRequest(link=f"{first}->{site}", to=to)
    shares = {first: share, second: round(1.0 - share, 3)}
    return site, ChangeRequest(dominance=site, to=shares, ramp_s=0.5)


def storm_of(fault: Fault) -> list[tuple[float, str, ChangeRequest]]:
    """Returns the orders to the sites in a storm, with their times, s after its beginning."""
    rng = Random(f"storm {fault.size}")
    lasts_s = min(fault.for_s, STORM_S)
    orders = []
    for _ in range(max(2, round(STORM_ORDERS * lasts_s / STORM_S))):
        site = _a_site(rng)
        if rng.random() < 0.8:
            request: tuple[str, ChangeRequest] = (
                *site,
                ChangeRequest(order=rng.choice(LATCHES)),
            )
        else:
            request = order_of(Fault("order", 0.0, 0.0, site, rng.random()))
        orders.append((rng.uniform(0.0, lasts_s), *request))
    return sorted(orders, key=lambda order: order[0])


def describe_faults(faults: Sequence[Fault]) -> str:
    return "\n".join(
        f"  {fault.at_s:.3f} s: {fault.kind} {' -> '.join(fault.of)} for {fault.for_s:g} s, {fault.size:g}"
        for fault in faults
    )
