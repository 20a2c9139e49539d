"""The page's tables of links, clocks and changes, as HTML.

Law: a table of what did not happen is not there.
"""

from html import escape

from ..log.reader import Log
from .summary import Facts
from .tables import number, swatch, table


def ages_html(log: Log, facts: Facts) -> str:
    """Returns the table of the links: what was stated, and what the controller saw."""
    rows = []
    for name, link in facts["links"].items():
        age: Facts = link["age_ms"]
        cells = [age["mean"], age["deviation"], *(age[key] for key in ("p50", "p99", "min", "max"))]
        share = link["ticks_without_new"]
        cells += [None if share is None else 100.0 * share, link["silence_ms"]]
        rows.append([_label(log, name), _stated(link), *map(_cell, cells)])
    return table(_AGE_HEADS, rows, words=[1])


def samples_html(log: Log, facts: Facts) -> str:
    """Returns the table of what became of the samples, with measured delays where there are any."""
    links: dict[str, Facts] = facts["links"]
    measured = any(link["one_way_us"] for link in links.values())
    rows = []
    for name, link in links.items():
        counts: Facts = link["samples"] or {}
        cells = [counts.get(key) for key in _COUNTS]
        loss = link["loss"]
        cells += [None if loss is None else 100.0 * loss, link["burst"]]
        if measured:
            way: Facts = link["one_way_us"] or {}
            clock: Facts = link["clock"] or {}
            cells += [*(way.get(key) for key in ("min", "p50", "p99", "max")), clock.get("bound_p50_us")]
        rows.append([_label(log, name), *map(_cell, cells)])
    return table([*_SAMPLE_HEADS, *(_WAY_HEADS if measured else ())], rows)


def clocks_html(log: Log, facts: Facts) -> str:
    """Returns the table of the clocks as sites saw them; "" where all read the same one."""
    rows = []
    for name, link in facts["links"].items():
        clock: Facts = link["clock"] or {}
        if clock and (clock["bound_max_us"] or clock["offset_us"]):
            rows.append([_label(log, name), *(_cell(clock[key]) for key in _CLOCK_KEYS)])
    return table(_CLOCK_HEADS, rows) if rows else ""


def changes_html(facts: Facts) -> str:
    """Returns the table of what was changed while it ran; "" where nothing was."""
    rows = []
    for n, changed in enumerate(facts["changes"], 1):
        tick = changed["taken_at_tick"]
        by = "scenario" if tick is None else f"ordered, taken in at tick {tick} of {changed['site']}"
        at_s = number(changed["at_s"])
        rows.append([str(n), _typeset(changed["about"]), at_s, _typeset(changed["to"]), escape(by)])
    return table(_CHANGE_HEADS, rows, words=[1, 3, 4]) if rows else ""


def modes_html(log: Log, facts: Facts) -> str:
    """Returns the table of when sites held, braked or returned; "" where none did."""
    rows = [
        [f"{swatch(log, name)}{escape(name)}", span["mode"], f"{span['from_s']:.3f}", f"{span['to_s']:.3f}"]
        for name, site in facts["sites"].items()
        for span in site["modes"][:_MOST]
    ]
    return table(("site", "mode", "from (s)", "to (s)"), rows, words=[1]) if rows else ""


def _label(log: Log, link: str) -> str:
    peer, site = link.split("->")
    return f"{swatch(log, peer)}{escape(peer)} → {escape(site)}"


def _stated(link: Facts) -> str:
    first, *later = link["stated"]
    words = [first["link"], *(f"from {state['from_s']:g} s: {state['link']}" for state in later)]
    return "<br>".join(map(_typeset, words))


def _typeset(text: str) -> str:
    return escape(text.replace("+-", "±").replace("->", " → "))


def _cell(value: float | None) -> str:
    if isinstance(value, int):
        return str(value)
    return number(value)


_MOST = 200
_COUNTS = ("sent", "missing", "lost", "late", "superseded", "duplicate", "copies")
_CLOCK_KEYS = (
    "offset_us",
    "offset_first_us",
    "drift_ppm",
    "drift_bound_ppm",
    "bound_us",
    "bound_p50_us",
    "bound_max_us",
    "rtt_min_us",
    "faults",
)
_AGE_HEADS = (
    "link",
    "stated delay",
    "effective, mean (ms)",
    "deviation",
    "p50",
    "p99",
    "min",
    "max",
    "nothing new (% of ticks)",
    "longest silence (ms)",
)
_SAMPLE_HEADS = (
    "link",
    "samples sent",
    "missing on the way",
    "lost by the model",
    "late",
    "superseded",
    "duplicates",
    "of the model",
    "lost in all (%)",
    "in a row",
)
_WAY_HEADS = ("one way, min (µs)", "p50", "p99", "max", "known to, p50 (µs)")
_CLOCK_HEADS = (
    "clock of the sender",
    "ahead at the end (µs)",
    "at the start",
    "drift (ppm)",
    "known to (ppm)",
    "offset known to, end (µs)",
    "p50",
    "max",
    "round trip, min (µs)",
    "faults",
)
_CHANGE_HEADS = ("no.", "what", "from (s)", "becomes", "by")
