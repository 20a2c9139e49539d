"""The tables of fields in trilat_net/core/README.md, as `row_fields.FIELDS` states them.

`python -m tests.core.core_readme` writes them into the file.
"""

import re
from pathlib import Path

from trilat_net.core.step.row_fields import FIELDS, Field

README = Path(__file__).parents[2] / "trilat_net" / "core" / "README.md"
_HEAD = "| field | shape | unit | meaning | written by |\n|---|---|---|---|---|\n"


def _render_row(name: str, field: Field) -> str:
    shape = field.shape or "1"
    if field.chain_only:
        shape += ", chain"
    return f"| `{name}` | {shape} | {field.unit} | {field.meaning} | {field.stage} |\n"


def render_table(row: str) -> str:
    """Returns the table of the fields of a row of `FIELDS`."""
    return _HEAD + "".join(_render_row(name, field) for name, field in FIELDS[row].items())


def insert_tables(text: str) -> str:
    """Returns the text of the README with the present tables between its marks."""
    for row in FIELDS:
        start = f"<!-- fields of {row} -->\n"
        end = "<!-- end -->\n"
        pattern = re.escape(start) + ".*?" + re.escape(end)
        table = start + render_table(row) + end
        text = re.sub(pattern, lambda _, table=table: table, text, flags=re.DOTALL)
    return text


if __name__ == "__main__":
    README.write_text(insert_tables(README.read_text(encoding="utf-8")), encoding="utf-8")
