"""Describes circumstances of a run that readers of its stability verdict should know about.

`analysis.run_remarks` finds these circumstances. This module writes, for example, "m1 and m2
were at their torque limit for 0.56 s and 0.43 s".
"""

from collections.abc import Callable, Iterable, Iterator
from typing import Any

from ..analysis import run_remarks
from ..errors import count_nouns, join_words


def _list_remarks(run: run_remarks.RunCircumstances) -> Iterator[str]:
    """Yields one sentence, without a full stop, for each circumstance that occurred."""
    if run.at_limit_s:
        verb = "was at its" if len(run.at_limit_s) == 1 else "were at their"
        durations = [f"{time_s:.3g} s" for time_s in run.at_limit_s.values()]
        yield f"{join_words(run.at_limit_s)} {verb} torque limit for {join_words(durations)}"

    if run.large_pushes:
        pushes = []
        for push in run.large_pushes:
            limit = f"(torque limit {push.limit_nm:g} N m)"
            torque = f"up to {push.torque_nm:.3g} N m {limit}"
            pushes.append(f"{push.site} joint {push.joint} with {torque}")
        yield f"hands or walls pushed {join_words(pushes)}"

    if run.late_ticks:
        counts = [
            f"{count_nouns(ticks, 'tick')} of {site}" for site, ticks in run.late_ticks.items()
        ]
        yield f"{join_words(counts)} began late, by a period or more"

    if run.odd_age is not None:
        age = run.odd_age
        is_older = age.age_ms > age.stated_ms
        cause = "losses and waiting count" if is_older else "the newest sample counts"
        yield (
            f"the samples in use on {age.link} were {age.age_ms:.4g} ms old on average, with a "
            f"stated mean delay of {age.stated_ms:.4g} ms, because {cause}"
        )

    if run.program_sites:
        is_single = len(run.program_sites) == 1
        moves = "a program moves" if is_single else "programs move"
        actors = "the program" if is_single else "these programs"
        yield (
            f"{moves} {join_words(run.program_sites)}; recorded actions were repeated, so the "
            f"roots and the pushes leave out how the arms and {actors} act on each other"
        )
    yield from run.failures


SENTENCE_LISTERS: dict[type, Callable[[Any], Iterable[str]]] = {
    run_remarks.RunCircumstances: _list_remarks
}
"""Function that lists the remarks on a run, keyed by the class that contains its circumstances.
"""
