"""Remarks of a certificate: rates of different motions, and a theorem that does not apply."""

from dataclasses import replace

import pytest

from tests.analysis.builders import make_run
from trilat_net.analysis.judge import certify_run
from trilat_net.analysis.stability_decision import LoopRoots
from trilat_net.presentation.certificate_text import describe_certificate, describe_theorem


@pytest.mark.parametrize(
    ("factor", "remarks"), [(1.0, 0), (1.0 + 1e-6, 0), (1.1, 1), (0.5, 1), (-1, 1)]
)
@pytest.mark.parametrize("exact", [True, False])
def test_rates_printing_differently_are_explained(
    factor: float, remarks: int, *, exact: bool
) -> None:
    certificate = certify_run(make_run("paper", {"duration_s": 16.0, "rate_hz": 100}).log)
    assert certificate.twins is not None
    assert certificate.twins.worst is not None
    rate_per_s = factor * certificate.twins.worst.rate_per_s
    roots = LoopRoots("stable", rate_per_s, exact)
    lines = describe_certificate(replace(certificate, roots=roots))
    lines_on_rates = [line for line in lines if line.text.startswith("of the two rates")]
    assert [line.mark for line in lines_on_rates] == ["note"] * remarks
    accuracy = "roots is exact" if exact else "roots is an approximation"
    assert all(accuracy in line.text and "is measured" in line.text for line in lines_on_rates)


def test_inapplicable_theorems_have_not_passed() -> None:
    certificate = make_run("wall").certificate
    (line,) = [
        line
        for line in describe_certificate(certificate)
        if line.text == certificate.verdict.text
    ]
    assert line.mark == "note"
    assert line.text.startswith(
        "the theorem does not apply (premises that fail: hands must add no energy); V rose"
    )
    assert describe_theorem(certificate) == [
        f"stability theorem of the paper (V: its energy function): {certificate.verdict.text}"
    ]


def test_laws_without_v_have_no_theorem() -> None:
    settings = {"control.law": "p_d", "duration_s": 1.0, "rate_hz": 200}
    assert describe_theorem(make_run("free", settings).certificate) == []
