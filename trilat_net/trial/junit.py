"""Results as JUnit XML, as GitLab, Jenkins and GitHub's actions read it.

Law: the shape is that of Jenkins' `junit-10.xsd`: a suite per scenario, a case per run. A case that did not
hold has one `failure` with all that did not, one that gave no result an `error`.
"""

import re
import xml.etree.ElementTree as Xml
from collections.abc import Sequence
from datetime import UTC, datetime

from .report import Report, margin_text
from .trial import Result

_NOT_XML = re.compile(r"[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def junit_xml(report: Report, began_unix_ns: int, host: str) -> bytes:
    """Returns the results as an XML document.

    Args:
        report: the results.
        began_unix_ns: when the first run began, ns since 1970.
        host: name of the machine.
    """
    root = Xml.Element("testsuites", _counts(report.results), name="trilat test")
    began = datetime.fromtimestamp(began_unix_ns // 10**9, UTC)
    for name, results in report.scenarios.items():
        suite = Xml.SubElement(
            root,
            "testsuite",
            _counts(results),
            name=_clean(name),
            skipped="0",
            timestamp=f"{began:%Y-%m-%dT%H:%M:%S}",
            hostname=_clean(host),
        )
        properties = Xml.SubElement(suite, "properties")
        for key, value in _properties(results):
            Xml.SubElement(properties, "property", name=key, value=_clean(value))
        for result in results:
            _add_case(suite, result)
    Xml.indent(root)
    document: bytes = Xml.tostring(root, encoding="utf-8", xml_declaration=True)
    return document + b"\n"


def _counts(results: Sequence[Result]) -> dict[str, str]:
    errors = sum(bool(result.error) for result in results)
    failures = sum(not result.held for result in results) - errors
    return {
        "tests": str(len(results)),
        "failures": str(failures),
        "errors": str(errors),
        "time": f"{sum(result.wall_s for result in results):.3f}",
    }


def _properties(results: Sequence[Result]) -> list[tuple[str, str]]:
    trial = results[0].trial
    return [
        ("driver", "live" if trial.live else "virtual"),
        ("source", trial.source),
        ("overrides", " ".join(trial.overrides)),
        ("duration_s", f"{trial.scenario.duration_s:g}"),
        ("simulated_s", f"{sum(result.simulated_s for result in results):.6g}"),
        ("random", str(trial.scenario.random).lower()),
    ]


def _add_case(suite: Xml.Element, result: Result) -> None:
    trial = result.trial
    case = Xml.SubElement(
        suite,
        "testcase",
        name=f"seed {trial.scenario.seed}",
        classname=f"trilat.{trial.scenario.name}",
        time=f"{result.wall_s:.3f}",
    )
    again = [
        f"again: {trial.again}",
        f"look:  trilat report {result.log}" if result.log else f"look:  {trial.look}",
    ]
    if not result.held:
        kind = "error" if result.error else "failure"
        found = Xml.SubElement(
            case,
            kind,
            type="error" if result.error else "expectation",
            message=_clean("; ".join(result.failures)),
        )
        found.text = _clean("\n".join([*result.failures, *again]))
    lines = [
        f"{'ok' if o.held else 'FAIL'} {o.key}: {o.measured}, asked {o.limit}"
        + (f" ({margin_text(o.margin)})" if o.margin is not None else "")
        for o in result.outcomes
    ]
    Xml.SubElement(case, "system-out").text = _clean("\n".join(lines))


def _clean(text: str) -> str:
    """Returns text without the characters that no XML document may hold, not even escaped."""
    return _NOT_XML.sub("\N{REPLACEMENT CHARACTER}", text)
