"""Writes docs/data/metric-labels.csv: the label of every metric, as commands print it, and its key.

python -m tests.metric_labels
"""

import csv
import io
from pathlib import Path

from trilat_net.analysis.metrics import log_metrics  # noqa: F401 (its import registers the metrics)
from trilat_net.analysis.metrics.measures import Quantity

TABLE = Path(__file__).parents[1] / "docs" / "data" / "metric-labels.csv"


def build_table() -> str:
    """Returns the table, sorted by label."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(["label", "key", "unit", "of"])
    rows = [
        (quantity.name, quantity.key, quantity.unit, quantity.of)
        for quantity in Quantity.list_all()
    ]
    writer.writerows(sorted(rows))
    return stream.getvalue()


if __name__ == "__main__":
    TABLE.write_text(build_table(), encoding="utf-8")
