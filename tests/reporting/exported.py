"""Logs to export, and what must be found in an export of one."""

from functools import cache
from pathlib import Path
from typing import Any

from tests.analysis import logs
from tests.log_editing import opened, recorded
from trilat_net.log.log_reader import Log
from trilat_net.net.messages import Event
from trilat_net.reporting.export import Exporter, ExportFormat


@cache
def log() -> Log:
    """A log with everything in it: links of all kinds, modes, changes, events, statistics."""
    awkward = Event(
        member="a",
        boot=2**64 - 1,
        kind="refused",
        text='says "no",\nand 1.5 °C',
        t_ns=-1,
        clocks={"a": "x"},
        n=0,
    )
    plain = Event(member="c", boot=7, kind="end", text="c made 5 ticks", t_ns=9_000_000, ticks=5, n=0)
    busy = logs.busy().log
    stats = opened(recorded("two_sites", {"duration_s": 0.4})).link_stats("m")
    told = [
        type(stat)(
            **{f: getattr(stat, f) for f in stat.__struct_fields__}
            | {"site": "a", "dropped": {"not finite": 3}, "offset_us": {"b": -4}}
        )
        for stat in stats
    ]
    return logs.rewritten(busy, keep=lambda s: s.tick % 400 < 40, others=[awkward, plain, *told])


def expected() -> dict[str, dict[str, list[Any]]]:
    """Per table the values of every column, as Python's own; None where there is none."""
    return {
        table.label: {column.name: column.rows(0, len(table)) for column in table.columns}
        for table in log().tables()
    }


def exported(form: str, folder: Path) -> Path:
    chosen = ExportFormat(form)
    path = folder / f"out-{form}"
    Exporter(chosen, path).export(log())
    assert [entry.name for entry in folder.iterdir()] == [path.name]
    return path
