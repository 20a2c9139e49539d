"""Runs side by side."""

import json

import pytest

from tests.analysis.logs import rewritten
from trilat_net.analysis.metrics.log_metrics import compare_metrics, comparison_to_json

from .written import pair, simulated


def test_row_is_largest_of_places_or_their_sum() -> None:
    log = pair(
        lambda site, _: {"tau": [3.0 if site == "m" else 4.0, 0.0], "q": [0.1, 0.0], "q_des": [0.0, 0.0]}
    )
    found = compare_metrics([log, log], ["a", "b"])
    assert found.columns == ("a", "b")
    assert found.row("peak_tau_nm").values == (4.0, 4.0)
    assert found.row("effort_nm2_s").values == pytest.approx((25.0 * 4.0, 25.0 * 4.0))
    assert found.row("max_error_rad").values == (0.1, 0.1)


def test_what_one_site_lacks_the_whole_run_lacks() -> None:
    """A largest value of some sites is none of the run; a site that cannot have one takes nothing away."""
    log = simulated("free", {"duration_s": 1.0, "rate_hz": 100})
    torn = rewritten(log, lambda state: state.site != "m2")
    row = compare_metrics([log, torn]).row("max_error_rad")
    assert row.values[0] is not None
    assert row.values[1] is None
    assert row.entries[1].why == "m2: no records of m2"


def test_rows_that_no_run_could_have_are_left_out() -> None:
    free = simulated("free", {"duration_s": 1.0, "rate_hz": 100})
    wall = simulated("contact", {"duration_s": 1.0, "rate_hz": 100})
    keys = [row.quantity.key for row in compare_metrics([free]).rows]
    assert "force_peak_n" not in keys
    assert "late_p99_us" not in keys
    both = compare_metrics([free, wall]).row("force_peak_n")
    assert both.values == (None, 0.0)
    with pytest.raises(KeyError):
        compare_metrics([free]).row("force_peak_n")


def test_json_has_a_value_and_a_reason_per_column() -> None:
    free = simulated("free", {"duration_s": 1.0, "rate_hz": 100})
    found = json.loads(json.dumps(comparison_to_json(compare_metrics([free])), allow_nan=False))
    assert found["columns"] == ["log"]
    for row in found["rows"]:
        assert (row["values"][0] is None) == (row["unknown"][0] is not None)
