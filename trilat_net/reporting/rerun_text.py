"""The effect of a rerun as text."""

from collections.abc import Iterator

from ..execution.rerun import LinkEffect, LogAndRerun, Rerun
from ..execution.rerun_request import describe_rerun_changes
from .result_text import Block
from .text_table import TextTable


def compose_rerun(again: Rerun) -> Iterator[Block]:
    """Yields what was executed with which changes, a table of the sites, and the other effects."""
    asked = again.request
    others = f"; {', '.join(asked.recorded)} as recorded" if asked.recorded else ""
    yield f"{asked.mode}: {', '.join(asked.replaced)} executed afresh{others}"
    for line in describe_rerun_changes(asked) or ["nothing is changed: this is the experiment of the log"]:
        yield f"  {line}"
    yield _tabulate_sites(again)
    yield from _lines(again)
    yield from (f"note: {note}" for note in again.notes)


def _tabulate_sites(again: Rerun) -> TextTable:
    headers = ("ticks", "identical", "rms e rad", "here", "max e rad", "here", "max tau N m", "here")
    rows = []
    for effect in again.sites.values():
        figures = (effect.error_rms_rad, effect.error_max_rad, effect.torque_max_nm)
        cells = [cell for pair in figures for cell in _cells(pair)]
        rows.append([effect.site, str(effect.executed), str(effect.identical), *cells])
    return TextTable(("site", *headers), rows, align="lr")


def _cells(pair: LogAndRerun | None) -> list[str]:
    return ["", ""] if pair is None else [f"{value:#.3g}" for value in pair]


def _lines(again: Rerun) -> list[str]:
    """Returns the other effects on sites and links, a sentence each."""
    lines = []
    for effect in again.sites.values():
        if effect.q_max_rad:
            most, at_s, rms = effect.q_max_rad, effect.q_max_at_s, effect.q_rms_rad
            lines.append(
                f"{effect.site}: q is up to {most:.3g} rad off the log, at {at_s:.3f} s; {rms:.3g} rad rms"
            )
        if effect.first is not None:
            first = effect.first
            at_s = first.tick / again.request.scenario.sites[effect.site].rate_hz
            was, now = _values(first.logged, first.computed)
            where = f"tick {first.tick} ({at_s:.3f} s)"
            lines.append(
                f"{effect.site}: the first difference is at {where}: {first.field} was {was}, is {now}"
            )
        if effect.diverged_at_s is not None:
            lines.append(f"{effect.site}: diverged at {effect.diverged_at_s:.3f} s and ends there")
    return lines + [_link_line(link) for link in again.links.values() if link.differs]


def _values(before: object, after: object) -> tuple[str, str]:
    """Returns two values, with as many digits as tell them apart."""
    short = tuple(f"{value:.6g}" if isinstance(value, float) else str(value) for value in (before, after))
    return (short[0], short[1]) if short[0] != short[1] else (repr(before), repr(after))


def _link_line(link: LinkEffect) -> str:
    mean, largest = link.age_mean_ms, link.age_max_ms
    before, after = (
        f"{a:.4g} ms old on average, {b:.4g} ms at most" for a, b in zip(mean, largest, strict=True)
    )
    return f"link {link.link}: samples in use were {before}; are {after}"
