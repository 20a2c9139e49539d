"""Export a log for other tools, in one of the formats of the folder `exports`.

Each format is a module of that folder with a constant `FORMAT`. `Exporter` finds the format,
checks its settings and its path, and writes the export.

Invariant:
    - Numbers that are read back from an export equal those of the log, bit for bit.
    - An export describes itself: its session, and the unit, meaning and source of every column.
    - An export is refused, if at all, before a log is read and before anything is written.
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
from ..results import JsonObject
from . import exports

EXPORT_MANIFEST = "about.json"
"""Name of the file that describes an exported folder and marks the folder as an export."""
Written = Callable[[int], None]
"""Function that is called with the number of records written since its last call."""


class ExportFormat(NamedTuple):
    """A format of exports, the constant `FORMAT` of a module in the folder `exports`.

    Attributes:
        write: function that writes a log. Its arguments are the log (with `many` a list of
            logs), the file or folder to write, and a function of type `Written` to report
            progress. Its keyword-only parameters are the settings of the format. The function
            returns a summary for the user, or None.
        ending: end of the default path, which begins with the name of the log.
        folder: True if the format writes a folder.
        extra: the arguments of `import_extra` if the format needs an optional package: the
            module, the extra that installs it, and the features that need it; or ().
        many: True if the format accepts several logs.
    """

    write: Callable[..., str | None]
    ending: str
    folder: bool = False
    extra: tuple[str, str, str] | tuple[()] = ()
    many: bool = False


class Exporter:
    """An export of logs to a file or a folder.

    Args:
        form: name of the format.
        path: the file or folder; None for a path next to the log, named after it.
        force: True to replace an earlier export.
        log: path of the log, or of its first part.
        settings: settings of the format by name, as a mapping or as pairs.

    Attributes:
        path: the file or folder.

    Raises:
        UsageError: there is no such format or setting, the path exists and `force` is False,
            or a package is missing.
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
        names = exports.list_export_formats()
        if form not in names:
            raise UsageError(f"--to is one of {', '.join(names)}, not {form!r}")
        module = import_module(f"{exports.__name__}.{form}")
        self._format: ExportFormat = module.FORMAT
        self._settings = _parse_settings(form, self._format.write, dict(settings))
        name = log.name.removesuffix(".active").removesuffix(".mcap")
        self.path = path or log.parent / (name + self._format.ending)
        self._force = force
        self._manifest = EXPORT_MANIFEST if self._format.folder else None
        refuse_existing(self.path, force=force, manifest=self._manifest)
        if self._format.extra:
            import_extra(*self._format.extra)

    def export(self, *logs: Log, progress: Progress = lambda _done, _total: None) -> str:
        """Writes logs to the path of this export.

        Args:
            *logs: the logs; a single log for most formats.
            progress: called with the numbers of written and of all records.

        Returns:
            The summary of the format, or "".

        Raises:
            LogError: a record cannot be read.
            LogRefused: the disk is full.
            UsageError: the path is not writable, or the format accepts a single log only.
        """
        if len(logs) > 1 and not self._format.many:
            raise UsageError(
                f"this format exports a single log, not {len(logs)} logs of different sessions"
            )
        total = sum(len(log[site]) for log in logs for site in log.sites)
        done = 0

        def report_written(records: int) -> None:
            nonlocal done
            done += records
            progress(done, total)

        source = list(logs) if self._format.many else logs[0]
        with stage_output(self.path, force=self._force, manifest=self._manifest) as path:
            summary = self._format.write(source, path, report_written, **self._settings)
        return summary or ""


def _parse_settings(
    form: str, write: Callable[..., Any], settings: dict[str, Any]
) -> dict[str, Any]:
    """Returns the settings of a format, converted to the types of its parameters.

    Args:
        form: name of the format.
        write: function whose keyword-only parameters, with their defaults, are the settings.
        settings: the values by name, as numbers or texts.

    Raises:
        UsageError: there is no such setting, or its value has another type.
    """
    types = {}
    for parameter in inspect.signature(write).parameters.values():
        if parameter.kind is parameter.KEYWORD_ONLY:
            types[parameter.name] = type(parameter.default)
    unknown = [name for name in settings if name not in types]
    if unknown:
        raise UsageError(
            f"{form} has no setting {unknown[0]!r}; it has {', '.join(types) or 'none'}"
        )
    try:
        return {name: types[name](str(value)) for name, value in settings.items()}
    except ValueError as error:
        raise UsageError(f"a setting of {form} cannot be read: {error}") from None


def store_tables(
    log: Log,
    written: Written,
    choose_name: Callable[[Table], str],
    store: Callable[[Table, str], Any],
) -> str:
    """Stores every table of a log, and returns the description of the export as JSON.

    Args:
        log: the log.
        written: called with the number of records of each table of records.
        choose_name: function that returns the name of a table in the export.
        store: function that stores a table under a name.
    """
    tables = {}
    for table in log.tables():
        name = choose_name(table)
        store(table, name)
        tables[name] = _describe_table(table)
        is_state = table.kind == "state"
        written(len(table) if is_state else 0)
    version = collect_provenance()["version_trilat-net"]
    facts = {
        "exported_by": f"trilat-net {version}",
        "session": log.session,
        "complete": log.complete,
        "records_missing": {site: log.missing(site) for site in log.sites},
        "no_value": "an empty field in CSV, null in Parquet, NaN in NPZ and MAT",
        "tables": tables,
    }
    return json.dumps(facts, indent=2, ensure_ascii=False) + "\n"


def _describe_table(table: Table) -> JsonObject:
    """Returns the meaning of a table's rows and of its columns."""
    columns = {}
    for column in table.columns:
        columns[column.name] = {
            "unit": column.unit,
            "meaning": column.meaning,
            "source": column.source,
        }
    return {"row": table.about, "rows": len(table), "columns": columns}


def describe_folder(log: Log, folder: Path, about: str) -> None:
    """Writes the description of an exported folder, and the scenario, into the folder.

    Args:
        log: the log.
        folder: the exported folder.
        about: the description, from `store_tables`.
    """
    (folder / EXPORT_MANIFEST).write_bytes(about.encode())
    (folder / SCENARIO).write_bytes(log.scenario_text.encode())


def name_inside(table: Table, name: str, separator: str) -> str:
    """Returns the name of a table inside an exported file.

    Args:
        table: the table.
        name: the name of the table's site, or of a table without a site.
        separator: text between the name and the kind of the table. Tables of records have no
            kind in their names.
    """
    return name if table.kind in ("", "state") else f"{name}{separator}{table.kind}"


def read_texts(column: Column) -> NDArray[Any]:
    """Returns the texts of a column as an array of NumPy strings, shape (K,)."""
    return np.array(column.values.tolist(), dtype=np.str_)
