"""Export of a log for other tools, in one of the formats of the folder `exports`.

Invariant: a number read back is the same, bit for bit. An export describes itself: unit,
meaning and source of every column, and its session. What can be refused is refused before
anything is read or written.
"""

import inspect
import json
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import UsageError
from ..files import import_extra, refuse_existing, stage_output
from ..log.data_tables import Column, Table
from ..log.log_layout import SCENARIO, collect_provenance
from ..log.log_reader import Log
from ..log.mcap_reader import Progress
from . import exports

EXPORT_MANIFEST = "about.json"
"""File of an exported folder; it distinguishes such a folder from any other."""
Written = Callable[[int], None]
"""Called with the number of records just written."""


class ExportFormat(NamedTuple):
    """A format of exports, `FORMAT` of a file in the folder `exports`.

    Attributes:
        write: writes a log to a file, or into a folder, tells how many records it has written
            since, and returns what else is to be said, or None; its keyword-only parameters are
            settings.
        ending: of the default path, after the name of the log.
        folder: whether it writes a folder.
        extra: the module that it imports, the optional dependency that has it, and what needs
            it; or ().
        many: whether it takes any number of logs, which `write` then gets as a list.
    """

    write: Callable[..., str | None]
    ending: str
    folder: bool = False
    extra: tuple[str, str, str] | tuple[()] = ()
    many: bool = False


class Exporter:
    """An export to a file, or to a folder, which is refused before a log is read.

    Attributes:
        path: the file or folder.

    Raises:
        UsageError: no such format or setting, the place is taken and `force` is false, a
            package is missing.
    """

    def __init__(
        self,
        form: str,
        path: Path | None,
        *,
        force: bool = False,
        log: Path = Path(),
        settings: Any = (),
    ) -> None:
        """Without a path it is next to the log, or its first part, and named after it;
        `settings` by name.
        """
        names = exports.list_export_formats()
        if form not in names:
            raise UsageError(f"--to is one of {', '.join(names)}, not {form!r}")
        self._format: ExportFormat = import_module(f"{exports.__name__}.{form}").FORMAT
        self._settings = _read_settings(form, self._format.write, dict(settings))
        name = log.name.removesuffix(".active").removesuffix(".mcap")
        self.path = path or log.parent / (name + self._format.ending)
        self._force = force
        self._manifest = EXPORT_MANIFEST if self._format.folder else None
        refuse_existing(self.path, force=force, manifest=self._manifest)
        if self._format.extra:
            import_extra(*self._format.extra)

    def export(self, *logs: Log, progress: Progress = lambda _done, _total: None) -> str:
        """Exports a log, or several, and returns what the format says of it; `progress` is of
        records.

        Raises:
            LogError: a record cannot be read.
            LogRefused: the disk is full.
            UsageError: the place cannot be written to, or the format takes one log alone.
        """
        if len(logs) > 1 and not self._format.many:
            raise UsageError(
                f"an export of this form is of one log; here are {len(logs)}, of other sessions"
            )
        total = sum(len(log[site]) for log in logs for site in log.sites)
        done = 0

        def written(records: int) -> None:
            nonlocal done
            done += records
            progress(done, total)

        with stage_output(self.path, force=self._force, manifest=self._manifest) as path:
            what = list(logs) if self._format.many else logs[0]
            return self._format.write(what, path, written, **self._settings) or ""


def _read_settings(
    form: str, write: Callable[..., Any], given: dict[str, Any]
) -> dict[str, Any]:
    """Returns settings as the keyword-only parameters of `write` take them."""
    parameters = inspect.signature(write).parameters.values()
    known = {one.name: type(one.default) for one in parameters if one.kind is one.KEYWORD_ONLY}
    if strange := [name for name in given if name not in known]:
        raise UsageError(
            f"{form} has no setting {strange[0]!r}; it has {', '.join(known) or 'none'}"
        )
    try:
        return {name: known[name](str(value)) for name, value in given.items()}
    except ValueError as error:
        raise UsageError(f"a setting of {form} cannot be read: {error}") from None


def store_tables(
    log: Log,
    written: Written,
    place: Callable[[Table], str],
    store: Callable[[Table, str], Any],
) -> str:
    """Stores every table at its place, and returns the description of the export as JSON."""
    tables = {}
    for table in log.tables():
        where = place(table)
        store(table, where)
        columns = {
            c.name: {"unit": c.unit, "meaning": c.meaning, "source": c.source}
            for c in table.columns
        }
        tables[where] = {"row": table.about, "rows": len(table), "columns": columns}
        written(len(table) if table.kind == "state" else 0)
    facts = {
        "exported_by": f"trilat-net {collect_provenance()['version_trilat-net']}",
        "session": log.session,
        "complete": log.complete,
        "records_missing": {site: log.missing(site) for site in log.sites},
        "no_value": "an empty field in CSV, null in Parquet, NaN in NPZ and MAT",
        "tables": tables,
    }
    return json.dumps(facts, indent=2, ensure_ascii=False) + "\n"


def describe_folder(log: Log, folder: Path, about: str) -> None:
    """Writes the description of an exported folder into it, and the scenario."""
    (folder / EXPORT_MANIFEST).write_bytes(about.encode())
    (folder / SCENARIO).write_bytes(log.scenario_text.encode())


def name_inside(table: Table, name: str, separator: str) -> str:
    """Returns the place of a table in a file: its name, and its kind if it is not the records
    of a site.
    """
    return name if table.kind in ("", "state") else f"{name}{separator}{table.kind}"


def read_texts(column: Column) -> NDArray[Any]:
    """Returns the texts of a column."""
    return np.array(column.values.tolist(), dtype=np.str_)
