"""Exports a log to a file or folder for use in other tools, such as CSV, MATLAB or Parquet.

Each format is a module in the folder `exports` with a constant `FORMAT`. `Exporter` looks up
the format by name, checks its settings and the output path, and writes the export. Tabular
formats share `store_tables`.

Invariant:
    - Numbers read back from an export equal those in the log, bit for bit.
    - An export is self-describing: it contains the session, and the unit, meaning and source of
      every column.
    - An impossible export is rejected before a log is read or any file is written.
"""

import inspect
import json
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

from ..errors import UsageError
from ..files import Extra, refuse_existing, stage_output
from ..log import SCENARIO, Log, Progress, Table, collect_provenance
from ..results import JsonObject
from . import exports

EXPORT_MANIFEST = "about.json"
"""Name of the file that describes an exported folder and identifies it as an export."""
Written = Callable[[int], None]
"""Function that is called with the number of records written since the last call."""


class ExportFormat(NamedTuple):
    """A file format to which logs can be exported, such as CSV.

    Each module in the folder `exports` defines one as its constant `FORMAT`.

    Attributes:
        write: Function that writes a log. It receives the log (a list of logs if `many` is
            True), the file or folder to write, a progress callback of type `Written`, and the
            settings of the format as keyword-only arguments. It returns a summary for the user,
            or `None`.
        ending: Suffix of the default output path, which is appended to the name of the log.
        folder: True if the format writes a folder.
        extra: Group of optional packages that the format needs. `None` if it needs none.
        module: Module that the format imports from this group.
        many: True if the format accepts several logs.
    """

    write: Callable[..., str | None]
    ending: str
    folder: bool = False
    extra: Extra | None = None
    module: str = ""
    many: bool = False


class Exporter:
    """A prepared export of logs to a file or a folder.

    The constructor checks all arguments, so that mistakes are reported before the log is read.
    `export` then writes the logs.

    Args:
        form: Name of the format.
        path: The file or folder to write. `None` for a path next to the log, named after it.
        force: True to replace an earlier export.
        log: Path of the log, or of its first part.
        settings: Settings of the format, as a mapping from name to value or as pairs.

    Attributes:
        path: The file or folder to write.

    Raises:
        UsageError: There is no such format or setting, the path exists and `force` is False, or
            a package is missing.
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
            raise UsageError(f"--to must be one of {', '.join(names)}, not {form!r}")

        module = import_module(f"{exports.__name__}.{form}")
        self._format: ExportFormat = module.FORMAT
        self._settings = _parse_settings(form, self._format.write, dict(settings))

        name = log.name.removesuffix(".active").removesuffix(".mcap")
        self.path = path or log.parent / (name + self._format.ending)
        self._force = force

        # An existing folder is replaced only if its manifest shows that it is an earlier
        # export.
        self._manifest = EXPORT_MANIFEST if self._format.folder else None
        refuse_existing(self.path, force=force, manifest=self._manifest)
        if self._format.extra:
            self._format.extra.import_module(self._format.module)

    def export(self, *logs: Log, progress: Progress = lambda _done, _total: None) -> str:
        """Writes the logs in the chosen format, for example as CSV tables.

        Args:
            *logs: The logs. Most formats accept only one.
            progress: Function that is called with the number of written records and the total
                number.

        Returns:
            Summary for the user. Empty if the format provides none.

        Raises:
            LogError: A record cannot be read.
            LogRefused: The disk is full.
            UsageError: The path is not writable, or the format accepts only one log.
        """
        if len(logs) > 1 and not self._format.many:
            raise UsageError(
                f"this format exports a single log, not {len(logs)} logs of different sessions"
            )

        total = 0
        for log in logs:
            total += sum(len(log[site]) for site in log.sites)
        done = 0

        def report_written(records: int) -> None:
            """Reports progress after more records have been written.

            Args:
                records: Number of records written since the last call.
            """
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
    """Converts the settings of an export, such as `fps=30`, to the types of their parameters.

    Settings from the command line are strings. A format declares its settings as keyword-only
    parameters of its function, whose default values determine the types.

    Args:
        form: Name of the format.
        write: Function of the format that writes a log.
        settings: Mapping from setting name to a number or string.

    Returns:
        The converted settings by name.

    Raises:
        UsageError: There is no such setting, or its value has the wrong type.
    """
    types = {}
    for parameter in inspect.signature(write).parameters.values():
        if parameter.kind is parameter.KEYWORD_ONLY:
            types[parameter.name] = type(parameter.default)

    unknown_names = [name for name in settings if name not in types]
    if unknown_names:
        valid_settings = f"the settings of {form} are {', '.join(types)}"
        if not types:
            valid_settings = f"{form} has no settings"
        raise UsageError(f"{form} has no setting {unknown_names[0]!r}; {valid_settings}")

    values = {}
    for name, value in settings.items():
        try:
            values[name] = types[name](str(value))
        except ValueError:
            kind_texts = {int: "a whole number", float: "a number"}
            kind_text = kind_texts.get(types[name], "a text")
            raise UsageError(
                f"{name} of {form} must be {kind_text}, not {str(value)!r}"
            ) from None
    return values


def store_tables(
    log: Log,
    written: Written,
    choose_name: Callable[[Table], str],
    store: Callable[[Table, str], Any],
) -> str:
    """Stores every table of a log in an export, and returns a description of the export.

    This loop is shared by all formats. The format supplies one function that names a table and
    one that stores it; the NumPy format, for example, adds each column to a dictionary of
    arrays.

    Args:
        log: Log of the run to export.
        written: Function that is called with the number of records of each table.
        choose_name: Function that returns the name of a table in the export.
        store: Function that stores a table under a name.

    Returns:
        Description of the session and of all columns, as a JSON string.
    """
    tables = {}
    for table in log.tables():
        name = choose_name(table)
        store(table, name)
        tables[name] = _describe_table(table)
        # Progress is counted in records, which are the rows of the tables of states.
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


def write_table_files(
    log: Log,
    folder: Path,
    written: Written,
    suffix: str,
    write_table: Callable[[Table, Path], None],
) -> None:
    """Writes every table of a log to a separate file, for formats such as CSV and Parquet.

    The folder also receives a description of all tables, and the scenario.

    Args:
        log: Log of the run to export.
        folder: Existing folder for the files.
        written: Function that is called with the number of records of each table.
        suffix: Suffix of the files, for example ".csv".
        write_table: Function that writes a table to a file.
    """
    description = store_tables(
        log,
        written,
        lambda table: f"{table.label}{suffix}",
        lambda table, file_name: write_table(table, folder / file_name),
    )
    _describe_folder(log, folder, description)


def _describe_table(table: Table) -> JsonObject:
    """Returns the meaning of a table's rows, and unit, meaning and source of each column."""
    columns = {}
    for column in table.columns:
        columns[column.name] = {
            "unit": column.unit,
            "meaning": column.meaning,
            "source": column.source,
        }
    return {"row": table.about, "rows": len(table), "columns": columns}


def _describe_folder(log: Log, folder: Path, about: str) -> None:
    """Writes files that explain an exported folder to later readers.

    These are a description of the columns, and the scenario of the run.

    Args:
        log: Log of the run to export.
        folder: The exported folder.
        about: Description of the export, from `store_tables`.
    """
    (folder / EXPORT_MANIFEST).write_bytes(about.encode())
    (folder / SCENARIO).write_bytes(log.scenario_text.encode())


def name_inside(table: Table, name: str, separator: str) -> str:
    """Returns the name under which a table of a log is stored in an exported file.

    The table of a site's records is named after the site. Other tables of the site also include
    the kind of table, as in "m1.link" for the statistics of its links.

    Args:
        table: Table of the log.
        name: Name of the site, or of the table if it does not belong to a site.
        separator: String placed between the name and the kind, such as ".".
    """
    return name if table.kind in ("", "state") else f"{name}{separator}{table.kind}"
