"""A metric is one file: reports, comparisons and expectations find a metric that was put beside
the others.
"""

from pathlib import Path

import pytest

import trilat_net
from tests import metric_labels
from tests.dropped_files import run_in_folder
from trilat_net.analysis.metrics.log_metrics import LogMetrics
from trilat_net.analysis.metrics.measures import Measure, measures
from trilat_net.analysis.run_view import RunView

METRIC = """
import numpy as np

from trilat_net.analysis.metrics.measures import Metric, Quantity, measures


@measures("site", "haste", Quantity("haste_rad_s", "mean |qd|", "rad/s"))
def measure_haste(view, site):
    return {"haste_rad_s": Metric.of_value(float(np.abs(view.log[site].qd).mean()))}
"""
LOOK = """
import json, sys
import trilat_net.analysis.metrics
trilat_net.analysis.metrics.__path__.append(sys.argv[1])
import trilat_net as tn
log = tn.simulate("free", {"duration_s": 0.5})
found = tn.metrics(log)
asked = {"duration_s": 0.5, "expect": {"metrics": {"haste_rad_s": [0.0, 10.0]}}}
(trial,) = tn.trials("free", set=asked)
swept = tn.sweep("free", ["link.delay_ms=20"], asked, metrics=["haste_rad_s"], out="o", jobs=1)
print(json.dumps({
    "json": found.to_dict()["sites"]["s"]["haste_rad_s"],
    "text": found.summary(),
    "frame": [row["key"] for row in found.to_rows()],
    "compared": tn.compare(log, log).metrics.row("haste_rad_s").values,
    "swept": swept.rows[0]["haste_rad_s"],
    "expected": [[one.key, one.held] for one in trial.check().outcomes],
}))
"""


def test_an_added_file_is_a_metric_everywhere(tmp_path: Path) -> None:
    (tmp_path / "haste.py").write_text(METRIC)
    output = run_in_folder(LOOK, tmp_path)
    assert 0.0 < output["json"] < output["compared"][0] == output["compared"][1]
    assert "mean |qd|" in output["text"]
    assert "haste_rad_s" in output["frame"]
    assert 0.0 < output["swept"] != output["compared"][0]
    assert ["metrics.haste_rad_s", True] in output["expected"]


def test_duplicate_keys_are_refused_with_both_files() -> None:
    def measure_again(_view: RunView, _site: str) -> dict[str, object]:
        return {}

    with pytest.raises(
        ValueError, match=r"rms_error_rad has two definitions, in .*motion_metrics and .*test"
    ):
        measures("site", "twice", LogMetrics.find_quantity("rms_error_rad"))(measure_again)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["free", "contact"])
def test_a_measure_gives_its_declared_quantities(name: str) -> None:
    view = RunView(trilat_net.simulate(name, {"duration_s": 0.2}))
    for measure in Measure.list_all():
        for subject in view.list_subjects(measure.of):
            assert set(measure.measure(view, subject)) == {
                quantity.key for quantity in measure.quantities
            }


def test_every_printed_label_is_documented() -> None:
    """The table of docs/reference/metrics.md has the label, key and unit of every metric."""
    assert metric_labels.TABLE.read_text(encoding="utf-8") == metric_labels.build_table()
