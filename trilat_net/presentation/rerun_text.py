"""Composes the text that compares a run with its rerun under other settings."""

from collections.abc import Iterator

from ..analysis import LogMetrics
from ..execution import Rerun
from .plot_signals import shared_unit
from .result_text import Block, TextTable


def compose_rerun(rerun: Rerun) -> Iterator[Block]:
    """Yields the text that compares a rerun with the log of the original run.

    The text names the sites that were run again and the settings that were changed. It compares
    the motion of their arms, and the ages of the samples that they used, with the log.

    Args:
        rerun: Result of the rerun.
    """
    request = rerun.request
    recorded = f"; {', '.join(request.recorded)} as recorded" if request.recorded else ""
    yield f"{request.mode}: {', '.join(request.replaced)} executed afresh{recorded}"

    changes = request.describe_changes()
    for line in changes or ["nothing is changed: this is the experiment of the log"]:
        yield f"  {line}"

    # The table has a row for each executed site, with pairs of columns: logged and rerun.
    undelayed = _compare_undelayed_errors(rerun)
    rows = []

    # Details that do not fit into the table.
    for effect in rerun.sites.values():
        pairs: list[tuple[float, float] | None] = []
        pairs += [effect.error_rms_rad, effect.error_max_rad]

        if undelayed:
            pairs.append(undelayed.get(effect.site))
        pairs.append(effect.torque_max_nm)
        cells = []
        for pair in pairs:
            cells += ["", ""] if pair is None else [f"{value:#.3g}" for value in pair]
        rows.append([effect.site, str(effect.executed), str(effect.identical), *cells])

    headers = ["site", "ticks", "identical", "rms e rad", "rerun", "max e rad", "rerun"]
    if undelayed:
        headers += ["undelayed", "rerun"]
    headers += ["max tau N m", "rerun"]
    yield TextTable(tuple(headers), rows, align="lr")
    if undelayed:
        unit = "rad" if shared_unit(rerun.before) == "rad" else "m"
        yield (
            f"undelayed: largest distance in {unit} from where the peers are at the same time, "
            "delay included"
        )
        yield (
            "e: error from what the site had received of its peers, which a longer delay "
            "need not raise"
        )
    for site in rerun.sites:
        for line in _describe_site_effect(rerun, site):
            yield f"{site}: {line}"
    for name, link in rerun.links.items():
        if link.differs:
            yield _describe_link_effect(rerun, name)
    yield from (f"note: {note}" for note in rerun.notes)


def _compare_undelayed_errors(rerun: Rerun) -> dict[str, tuple[float, float]]:
    """Returns how far arms were from the others at the same time, in a log and in its rerun.

    The tracking error compares an arm with delayed states of the others. The undelayed error
    compares it with their states at the same time, and shows the effect of a different delay.
    The runs are compared at times for which both have a record. Sites that follow no other site
    have no such error, and are omitted.

    Returns:
        For each site, the largest undelayed error in the log and in the rerun.
    """
    sites = [site for site, effect in rerun.sites.items() if effect.compared]
    logged = LogMetrics.find_undelayed_maxima(rerun.before, sites, rerun.after)
    repeated = LogMetrics.find_undelayed_maxima(rerun.after, sites, rerun.before)
    return {site: (logged[site], repeated[site]) for site in logged if site in repeated}


_USED_FIELD = "used["
"""Prefix of record fields that contain the tick of the peer sample in use."""


def _name_sample(tick: object) -> str:
    """Returns a name for the peer sample in use, from its tick (-1 before the first sample)."""
    return "none" if tick == -1 else f"that of tick {tick}"


def _describe_site_effect(rerun: Rerun, site: str) -> list[str]:
    """Returns lines about the differences between an arm in the log and in the rerun.

    The lines state the largest deviation of the joint angles, and the first value that differs.

    Args:
        rerun: Result of the rerun.
        site: Name of the site.
    """
    effect = rerun.sites[site]
    rate_hz = rerun.request.scenario.sites[site].rate_hz
    lines = []
    if effect.q_max_rad:
        largest_text = f"{effect.q_max_rad:.3g} rad off the log, at {effect.q_max_at_s:.3f} s"
        lines.append(f"q is up to {largest_text}; {effect.q_rms_rad:.3g} rad rms")

    first_difference = effect.first
    if first_difference is not None:
        logged_text, computed_text = _format_difference(
            first_difference.logged, first_difference.computed
        )
        time_text = f"tick {first_difference.tick} ({first_difference.tick / rate_hz:.3f} s)"
        change = f"{first_difference.field} was {logged_text}, is {computed_text}"
        if first_difference.field.startswith(_USED_FIELD):
            peer = first_difference.field.removeprefix(_USED_FIELD).removesuffix("]")
            logged_sample = _name_sample(first_difference.logged)
            computed_sample = _name_sample(first_difference.computed)
            change = f"the sample of {peer} in use was {logged_sample}, is {computed_sample}"
        lines.append(f"the first difference is at {time_text}: {change}")

    if effect.diverged_at_s is not None:
        lines.append(f"diverged at {effect.diverged_at_s:.3f} s and ends there")
    return lines


def _describe_link_effect(rerun: Rerun, name: str) -> str:
    """Returns a sentence that compares a link's sample ages in the log and in the rerun."""
    link = rerun.links[name]
    mean_ms = link.age_mean_ms
    max_ms = link.age_max_ms
    before = f"{mean_ms.before:.4g} ms old on average, {max_ms.before:.4g} ms at most"
    after = f"{mean_ms.after:.4g} ms old on average, {max_ms.after:.4g} ms at most"
    return f"link {link.link}: samples in use were {before}; are {after}"


def _format_difference(before: object, after: object) -> tuple[str, str]:
    """Formats two different values such that the resulting strings differ.

    Numbers are written with six digits, or with all digits if the strings would otherwise be
    equal.

    Args:
        before: The value in the first log.
        after: The value in the second log.
    """
    short_before = f"{before:.6g}" if isinstance(before, float) else str(before)
    short_after = f"{after:.6g}" if isinstance(after, float) else str(after)
    if short_before == short_after:
        return repr(before), repr(after)
    return short_before, short_after
