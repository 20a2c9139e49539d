"""A file at a glance: what `trilat log info` tells.

Law: whatever can be read is told. A log that cannot be opened still has an inventory, and says why it cannot.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..errors import LogError
from ..log.chunks import Progress
from ..log.reader import open_log
from ..log.writer import SESSION
from .inventory import Inventory
from .vitals import link_facts, session_facts, site_facts

Facts = dict[str, Any]


def overview(paths: Sequence[Path], progress: Progress | None = None) -> Facts:
    """Returns what is in a file, or in the parts of one log, ready for JSON; keys end in their units.

    Args:
        paths: the files.
        progress: told how much is read, and how much there is.

    Returns:
        files: facts of each.
        kind: "trilat" for a log of ours that could be opened, else "mcap".
        problem: why a log of ours could not be opened, or None.
        session, sites, links: of a log of ours; else None, and empty.
        channels: facts of each, by topic.

    Raises:
        LogError: a file cannot be read, or is no MCAP file.
    """
    inventory = Inventory(paths, _half(progress, 0))
    facts: Facts = {"files": inventory.files, "kind": "mcap", "problem": None, "session": None}
    facts |= {"sites": {}, "links": {}}
    name, rates_hz = "", {}
    if SESSION in inventory.metadata:
        try:
            log = open_log(*paths, progress=_half(progress, 1))
            sites = {site: site_facts(log, site) for site in log.sites}
            links = {
                f"{peer}->{site}": link_facts(log, peer, site)
                for site in log.sites
                for peer in log[site].peers
            }
            facts |= {"kind": "trilat", "session": session_facts(log), "sites": sites, "links": links}
            name = log.session["session"]
            rates_hz = {site: log.scenario.sites[site].rate_hz for site in log.sites}
        except LogError as error:
            facts["problem"] = str(error)
    facts["channels"] = inventory.channels(name, rates_hz)
    return facts


def _half(progress: Progress | None, which: int) -> Progress | None:
    """Returns what tells of the first or the second half of the work."""
    if progress is None:
        return None
    return lambda done, total: progress(which * total + done, 2 * total)
