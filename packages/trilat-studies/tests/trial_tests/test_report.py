"""The table: the worst of the runs, and every failed run with its command; JUnit XML as its
readers expect.
"""

import xml.etree.ElementTree as Xml

from hypothesis import given
from hypothesis import strategies as st
from study_builders import make_trial_result
from trilat_studies.expectations import ExpectationResult
from trilat_studies.trials import MAX_FAILURES_SHOWN, TrialReport


def outcome(margin: float, key: str = "rms_error_max_rad") -> ExpectationResult:
    return ExpectationResult(
        key, margin >= 0.0, f"{0.1 * (1 - margin):.4g} rad", "≤ 0.1 rad", margin
    )


def test_row_shows_worst_run_and_passed_count() -> None:
    report = TrialReport(
        [make_trial_result(n, outcome(m)) for n, m in enumerate((0.5, -0.2, 0.1, -0.1))], 4.0
    )
    (row,) = report.rows()
    assert (row.worst.margin, row.held, row.runs) == (-0.2, 2, 4)
    assert row.cells() == (
        "FAIL",
        "quick.toml",
        "rms_error_max_rad",
        "≤ 0.1 rad",
        "0.12 rad",
        "-20 %",
        "2/4",
    )
    assert not report.held


def test_failures_precede_the_smallest_margin() -> None:
    failed = ExpectationResult("stable", False, "grows", "true")
    (row,) = TrialReport(
        [
            make_trial_result(1, ExpectationResult("stable", True, "decays", "true")),
            make_trial_result(2, failed),
        ],
        1.0,
    ).rows()
    assert row.worst is failed


def test_failed_runs_are_named_first_with_commands() -> None:
    report = TrialReport(
        [make_trial_result(n, outcome(-0.1)) for n in range(1, MAX_FAILURES_SHOWN + 4)], 1.0
    )
    lines = report.failures()
    for seed in range(1, MAX_FAILURES_SHOWN + 1):
        assert f"  again: trilat test quick.toml --seeds {seed}" in lines
        assert f"  look:  trilat sim quick.toml --seed {seed} -o quick-seed{seed}.mcap" in lines
    assert (
        lines[-1]
        == f"  and 3 more, seeds {MAX_FAILURES_SHOWN + 1}, {MAX_FAILURES_SHOWN + 2}, {MAX_FAILURES_SHOWN + 3}"
    )


def test_runs_without_result_fail_with_a_reason() -> None:
    report = TrialReport(
        [
            make_trial_result(1, outcome(0.5)),
            make_trial_result(2, error="its process ended with code -9"),
        ],
        1.0,
    )
    assert not report.held
    assert [(row.key, row.held, row.runs) for row in report.rows()] == [
        ("rms_error_max_rad", 1, 1),
        ("a result", 1, 2),
    ]
    assert "code -9" in report.summary()


def test_passed_results_are_reported_without_failures() -> None:
    report = TrialReport(
        [make_trial_result(1, outcome(0.5)), make_trial_result(2, outcome(0.25))], 4.0
    )
    assert report.held
    assert report.failures() == []
    assert report.remarks() == ["2 runs, 40 s simulated in 4.0 s: 10x"]


def test_scenarios_of_one_name_are_distinguished() -> None:
    report = TrialReport(
        [make_trial_result(1, outcome(0.5), source=name) for name in ("a.toml", "b/a.toml")],
        1.0,
    )
    assert [row.scenario for row in report.rows()] == ["a.toml", "b/a.toml"]


def test_the_lines_of_a_table_are_aligned() -> None:
    report = TrialReport(
        [make_trial_result(1, outcome(0.5), outcome(-123.0, "end_error_max_rad"))], 1.0
    )
    heads, *rows = report.table()
    assert all(len(row) == len(heads) for row in rows)
    assert all(row.index("≤") == heads.index("limit") for row in rows)


def test_a_margin_is_a_percentage_with_its_sign() -> None:
    margins = (0.0, 0.2, -0.05, 0.0012, -2192.87)
    reports = [TrialReport([make_trial_result(1, outcome(m))], 1.0) for m in margins]
    (unknown,) = TrialReport([make_trial_result(1, GOOD)], 1.0).rows()
    assert unknown.cells()[5] == ""
    assert [row.cells()[5] for report in reports for row in report.rows()] == [
        "+0.0 %",
        "+20 %",
        "-5.0 %",
        "+0.1 %",
        "-219,287 %",
    ]


GOOD = ExpectationResult("stable", True, "decays", "true")
BAD = ExpectationResult("rms_error_max_rad", False, "0.3 rad", "≤ 0.1 rad", -2.0)

ALLOWED = {
    "testsuites": ({"name", "time", "tests", "failures", "errors"}, {"testsuite"}),
    "testsuite": (
        {"name", "tests", "failures", "errors", "skipped", "time", "timestamp", "hostname"},
        {"properties", "testcase"},
    ),
    "properties": (set(), {"property"}),
    "property": ({"name", "value"}, set()),
    "testcase": ({"name", "classname", "time"}, {"failure", "error", "system-out"}),
    "failure": ({"type", "message"}, set()),
    "error": ({"type", "message"}, set()),
    "system-out": (set(), set()),
}
"""Attributes and children, as far as they are used here, of Jenkins' junit-10.xsd; all are optional there
but `name` of suites and cases, the counts of a suite, and both of a property, which are always written."""


def document(report: TrialReport) -> Xml.Element:
    return Xml.fromstring(report.encode_junit_xml(1_700_000_000 * 10**9, "host"))


def mixed() -> TrialReport:
    return TrialReport(
        [
            make_trial_result(1, GOOD, BAD),
            make_trial_result(2, GOOD),
            make_trial_result(3, error="lost"),
            make_trial_result(1, GOOD, source="b.toml"),
        ],
        2.0,
    )


def test_junit_has_the_shape_its_readers_know() -> None:
    for element in document(mixed()).iter():
        attributes, children = ALLOWED[element.tag]
        assert set(element.keys()) <= attributes, element.tag
        assert {child.tag for child in element} <= children
        assert element.tag not in ("testsuite", "testcase", "property") or element.get("name")


def test_junit_counts_suites_and_cases_correctly() -> None:
    root = document(mixed())
    suites = root.findall("testsuite")
    assert [suite.get("name") for suite in suites] == ["quick.toml", "b.toml"]
    assert [(s.get("tests"), s.get("failures"), s.get("errors")) for s in suites] == [
        ("3", "1", "1"),
        ("1", "0", "0"),
    ]
    assert (root.get("tests"), root.get("failures"), root.get("errors")) == ("4", "1", "1")
    assert [case.get("name") for case in suites[0]][1:] == ["seed 1", "seed 2", "seed 3"]
    assert suites[0].get("timestamp") == "2023-11-14T22:13:20"
    assert suites[0].get("time") == "1.500"


def test_a_failure_carries_the_figures_and_the_command() -> None:
    root = document(mixed())
    (failure,) = root.iter("failure")
    assert failure.get("message") == "rms_error_max_rad: 0.3 rad, expected ≤ 0.1 rad"
    assert failure.text is not None
    assert "again: trilat test quick.toml --seeds 1" in failure.text
    (error,) = root.iter("error")
    assert "lost" in str(error.get("message"))


def test_properties_describe_the_run() -> None:
    suite = document(mixed()).find("testsuite")
    assert suite is not None
    properties = {p.get("name"): p.get("value") for p in suite.iter("property")}
    assert properties["driver"] == "virtual"
    assert properties["random"] == "true"
    assert properties["simulated_s"] == "60"


@given(text=st.text())
def test_any_text_is_escaped_or_replaced(text: str) -> None:
    failed = ExpectationResult("stable", False, text, text)
    root = document(
        TrialReport([make_trial_result(1, failed, error=text or "x", source=text or "x")], 1.0)
    )
    assert len(list(root.iter("testcase"))) == 1
