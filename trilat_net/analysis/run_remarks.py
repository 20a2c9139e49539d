"""Finds conditions of a run that a reader of its stability judgement should know.

For example, a run may be stable although a motor was at its torque limit for 2 s. Such a
condition does not change the judgement, but shows that the arms or the computers were at their
limits. A remark is made if:

- a motor was at its torque limit, so that the control law did not act in full;
- an operator or a wall pushed with a large share of the torque limit;
- ticks (periods of the control loop) began late by a whole period or more;
- samples in use were clearly younger or older than the delay that their link states;
- a program of the user moved an arm, or failed while it did.

Invariant:
    - A remark states a number for each arm that it names.
    - A condition that did not occur has no remark.
"""

import numpy as np

from ..errors import count_nouns, join_words
from ..log import Log
from .dominance_history import list_program_sites
from .link_summary import sample_ages_ns
from .site_signals import external_torques
from .timeline import list_effective_commands

LARGE_PUSH_SHARE = 0.5
"""Least torque of operators and walls that is remarked, as a share of the torque limit."""


LARGE_AGE_SHARE = 0.05
"""Least remarked difference of the mean age in use from the stated delay, as its share."""


def list_remarks(log: Log) -> tuple[str, ...]:
    """Lists circumstances of a run that may explain why it was judged stable or not.

    An example is a motor at its torque limit.

    Args:
        log: Log of the run.

    Returns:
        Sentences without a full stop, for example "m1 and m2 were at their torque limit for
        0.56 s and 0.43 s".
    """
    candidates = (
        _describe_torque_limits(log),
        _describe_large_pushes(log),
        _describe_late_ticks(log),
        _describe_ages(log),
        _describe_programs(log),
        *log.failed_hands,
    )
    return tuple(remark for remark in candidates if remark)


def _describe_programs(log: Log) -> str:
    """Returns a remark that programs moved arms, and that the judgement ignores how they react.

    The remark is empty if no program moved an arm.
    """
    sites = list_program_sites(log)
    if not sites:
        return ""
    moves = "a program moves" if len(sites) == 1 else "programs move"
    actors = "the program" if len(sites) == 1 else "these programs"
    return (
        f"{moves} {join_words(sites)}; recorded actions were repeated, so the roots and the "
        f"pushes leave out how the arms and {actors} act on each other"
    )


def _describe_torque_limits(log: Log) -> str:
    """Returns a clause on how long each arm's motors were at their torque limit.

    At its limit a motor does not apply the torque that the control law demands. The clause is
    empty if no motor was at its limit.

    Args:
        log: The log of the run.
    """
    durations = {}
    for site in log.sites:
        site_log = log[site]
        limit_nm = log.scenario.sites[site].limits.tau_limit_nm
        at_limit = np.any(np.abs(site_log.tau) >= limit_nm, axis=1)
        if at_limit.any():
            durations[site] = f"{np.count_nonzero(at_limit) / site_log.rate_hz:.3g} s"

    if not durations:
        return ""
    verb = "was at its" if len(durations) == 1 else "were at their"
    return f"{join_words(durations)} {verb} torque limit for {join_words(durations.values())}"


def _describe_large_pushes(log: Log) -> str:
    """Returns a remark if operators or walls pushed with a large part of the torque limit.

    Motors that work near their limit cannot follow the control law any more.

    Returns:
        The clause. Empty if every push was small at every joint.
    """
    pushes = {}
    for site in log.sites:
        limit_nm = log.scenario.sites[site].limits.tau_limit_nm
        torques_nm = np.abs(external_torques(log[site]))
        peaks_nm = torques_nm.max(axis=0, initial=0.0)
        limits_nm = np.broadcast_to(limit_nm, peaks_nm.shape)
        joint = int(np.argmax(peaks_nm / limits_nm))
        if peaks_nm[joint] > LARGE_PUSH_SHARE * limits_nm[joint]:
            push = f"up to {peaks_nm[joint]:.3g} N m (torque limit {limits_nm[joint]:g} N m)"
            pushes[site] = f"{site} joint {joint + 1} with {push}"
    return f"hands or walls pushed {join_words(pushes.values())}" if pushes else ""


def _describe_late_ticks(log: Log) -> str:
    """Returns a remark on control periods (ticks) that began late by a period or more.

    Such periods occur on a busy machine. The text is empty if all began in time.
    """
    counts = {}
    for site in log.sites:
        site_log = log[site]
        late = int(np.count_nonzero(site_log.late_us >= 1e6 / site_log.rate_hz))
        if late:
            counts[site] = f"{count_nouns(late, 'tick')} of {site}"
    if not counts:
        return ""
    return f"{join_words(counts.values())} began late, by a period or more"


def _describe_ages(log: Log) -> str:
    """Returns how old the samples in use were, if a drawn delay states another age.

    Under jitter the newest sample that arrived counts, so that the samples in use are younger
    than the mean delay. Lost samples, and samples that wait for older ones, make them older.
    Links that change during the run are left out.

    Returns:
        The clause, about the link with the largest difference. Empty if every link agrees.
    """
    changed = {change.link for change in log.scenario.timeline}
    changed |= {change.link for change in list_effective_commands(log)}
    # by link: relative difference of the ages, mean age in use, and stated mean delay
    differences = {}
    for name, link in log.scenario.links.items():
        stated_ms, deviation_ms = link.moments()
        is_jittered = link.random and deviation_ms > 0.0 and stated_ms > 0.0
        if name in changed or link.measured or not is_jittered:
            continue

        peer, site = name.split("->")
        ages_ns = sample_ages_ns(log, peer, site)
        if len(ages_ns):
            age_ms = 1e-6 * float(ages_ns.mean())
            differences[name] = (age_ms / stated_ms - 1.0, age_ms, stated_ms)

    if not differences:
        return ""
    name, (difference, age_ms, stated_ms) = max(
        differences.items(), key=lambda item: abs(item[1][0])
    )
    if abs(difference) <= LARGE_AGE_SHARE:
        return ""

    cause = "losses and waiting count" if difference > 0.0 else "the newest sample counts"
    return (
        f"the samples in use on {name} were {age_ms:.4g} ms old on average, with a stated mean "
        f"delay of {stated_ms:.4g} ms, because {cause}"
    )
