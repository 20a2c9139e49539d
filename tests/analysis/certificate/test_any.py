"""Every run has a certificate, in words and in finite numbers, that accuses nobody."""

import json
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import trilat_net
from trilat_net.analysis.certificate.stability_certificate import Certificate
from trilat_net.errors import ScenarioError
from trilat_net.presentation.certificate_text import describe_certificate, list_energies
from trilat_net.presentation.verdict_text import FALSE_RECORDS_TEXT
from trilat_net.scenario import load_scenario

SCENARIOS = (
    "asymmetric",
    "box",
    "contact",
    "free",
    "handover",
    "lyapunov",
    "outage",
    "training",
    "two_sites",
)
CHANGES: dict[str, list[Any]] = {
    "rate_hz": [20, 77, 200],
    "scheme": ["digital", "second_order"],
    "link.delay_ms": [0.0, 7.3, 300.0],
    "link.loss": [0.3, 1.0],
    "control.law": ["adaptive", "adaptive_box", "p_d"],
    "control.Kd": [0.0, 30.0],
    "control.Kp": [0.01, 100.0],
    "control.Gamma": [0.0, 100.0, [1.0, 1.0, 1.0, 0.0, 0.0]],
    "control.theta_hat0": [0.0, 1e3],
    "sites.s.control.Kd": [[1.0, 3.0]],
    "limits.tau_limit_nm": [1.0],
    "limits.qd_limit_rad_s": [0.5],
    "arm.m2_kg": [1e-3, 50.0],
    "arm.g_m_s2": [0.0],
    "on_stale.action": ["hold", "brake"],
    "on_stale.age_ms": [1.0, 100.0],
}
changes = st.dictionaries(st.sampled_from(sorted(CHANGES)), st.integers(0, 2), max_size=4)


@settings(max_examples=25)
@given(st.sampled_from(SCENARIOS), changes, st.sampled_from([0.02, 0.5, 1.5]))
def test_every_run_has_a_certificate(
    name: str, picks: dict[str, int], duration_s: float
) -> None:
    overrides = {key: CHANGES[key][pick % len(CHANGES[key])] for key, pick in picks.items()}
    try:
        scenario = load_scenario(name, {"rate_hz": 100, "duration_s": duration_s, **overrides})
    except ScenarioError:
        return
    certificate = Certificate.of_log(trilat_net.simulate(scenario))
    facts = json.loads(json.dumps(certificate.to_dict(), allow_nan=False))
    assert FALSE_RECORDS_TEXT not in facts["text"] or "tells which" in facts["text"]
    assert all(
        line.text and "nan" not in line.text.split()
        for line in describe_certificate(certificate)
    )
    assert certificate.passed is (describe_certificate(certificate)[0].mark == "ok")
    if certificate.balance is not None:
        (_, first), *between, (_, last) = list_energies(certificate.balance)
        assert first + sum(x for _, x in between) == pytest.approx(
            last, abs=2e-5 * certificate.balance.scale + 1e-9
        )
