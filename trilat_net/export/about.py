"""What goes with exported tables: what every column is, and the session that it is of.

Law: a file that somebody finds years later explains itself.
"""

import json
from collections.abc import Iterable
from typing import Any

from ..log.provenance import provenance
from ..log.reader import Log
from ..log.table import Table

Facts = dict[str, Any]


def table_facts(table: Table) -> Facts:
    """Returns what a table's rows and columns are."""
    return {
        "row": table.about,
        "rows": len(table),
        "columns": {
            column.name: {"unit": column.unit, "meaning": column.meaning, "source": column.source}
            for column in table.columns
        },
    }


def about(log: Log, tables: Iterable[tuple[str, Facts]]) -> str:
    """Returns what an export is, as JSON.

    Args:
        log: the log.
        tables: every table's facts, by where it stands.
    """
    facts = {
        "exported_by": f"trilat-net {provenance()['version_trilat-net']}",
        "session": log.session,
        "complete": log.complete,
        "records_missing": {site: log.missing(site) for site in log.sites},
        "no_value": "an empty field in CSV, null in Parquet, NaN in NPZ and MAT",
        "tables": dict(tables),
    }
    return json.dumps(facts, indent=2, ensure_ascii=False) + "\n"
