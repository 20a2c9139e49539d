"""JUnit XML: the elements and attributes that readers know, counts that add up, any text escaped."""

import xml.etree.ElementTree as Xml

from hypothesis import given
from hypothesis import strategies as st

from trilat_net.studies.trials.expectations import ExpectationResult
from trilat_net.studies.trials.trial_report import TrialReport, encode_junit_xml

from .results import result

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
    return Xml.fromstring(encode_junit_xml(report, 1_700_000_000 * 10**9, "host"))


def mixed() -> TrialReport:
    return TrialReport(
        [result(1, GOOD, BAD), result(2, GOOD), result(3, error="lost"), result(1, GOOD, source="b.toml")],
        2.0,
    )


def test_the_shape_is_the_one_that_readers_know() -> None:
    for element in document(mixed()).iter():
        attributes, children = ALLOWED[element.tag]
        assert set(element.keys()) <= attributes, element.tag
        assert {child.tag for child in element} <= children
        assert element.tag not in ("testsuite", "testcase", "property") or element.get("name")


def test_a_suite_per_scenario_a_case_per_run_and_the_counts_add_up() -> None:
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
    assert failure.get("message") == "rms_error_max_rad: 0.3 rad, asked ≤ 0.1 rad"
    assert failure.text is not None
    assert "again: trilat test quick.toml --seeds 1" in failure.text
    (error,) = root.iter("error")
    assert "lost" in str(error.get("message"))


def test_properties_say_what_was_run() -> None:
    suite = document(mixed()).find("testsuite")
    assert suite is not None
    found = {p.get("name"): p.get("value") for p in suite.iter("property")}
    assert found["driver"] == "virtual"
    assert found["random"] == "true"
    assert found["simulated_s"] == "60"


@given(text=st.text())
def test_any_text_is_escaped_or_replaced(text: str) -> None:
    failed = ExpectationResult("stable", False, text, text)
    root = document(TrialReport([result(1, failed, error=text or "x", source=text or "x")], 1.0))
    assert len(list(root.iter("testcase"))) == 1
