"""Each premise, where it holds and where it does not."""

import pytest

from trilat_net.analysis.certificate.premises import Premise

from . import runs

SHORT = {"duration_s": 1.5, "rate_hz": 200, "link.delay_ms": 100.0}
CUT = {"links.m2->s.outages_s": [[0.45, 1.0]], "links.m2->s.delay_ms": 100.0}
LATE = {"links.m1->s.outages_s": [[0.0, 0.5]], "links.m1->s.delay_ms": 100.0}


def premises(name: str = "free", **overrides: object) -> dict[str, Premise]:
    made = {**SHORT, **{key.replace("__", "."): value for key, value in overrides.items()}}
    return {p.name: p for p in runs.run(name, made).certificate.premises}


def test_all_hold_in_free_motion() -> None:
    found = premises()
    assert [p.name for p in found.values() if p.holds is not True] == []
    assert found["delays"].text == "constant on every link: 100 ms"
    assert found["hands"].text == "nobody pushes"


@pytest.mark.parametrize(
    ("name", "overrides", "says"),
    [
        ("law", {"sites__m2__control__law": "p_d"}, "m2: law p_d, for which there is no such V"),
        ("parameters", {"control__Gamma": [1.0, 1.0, 1.0, 0.0, 0.0]}, "not learnt, and not known"),
        (
            "parameters",
            {"control__law": "adaptive_box", "control__theta_high": 1.9},
            "theta is outside of the box",
        ),
        ("Kd", {"sites__s__control__Kd": [1.0, 3.0]}, "no beta exists: m1 (3, 3), m2 (3, 3), s (1, 3)"),
        ("Kd", {"control__Kd": 0.0}, "some Kd is zero"),
        ("shares", runs.EXPERT, "nobody of m1, s follows m2, whose beta is 0"),
        ("delays", {"link__model": "uniform", "link__half_width_ms": 30.0}, "the age of the sample in"),
        ("delays", {"sites__m1__rate_hz": 100}, "varies"),
        ("delays", LATE, "m1->s"),  # ages before a first sample do not count, but it must not be late
        (
            "following",
            {"on_stale__action": "hold", "on_stale__age_ms": 150.0, **CUT},
            "brake or return: s 0.6 to 1.",
        ),
        ("torque", {"limits__tau_limit_nm": 10.0}, "cut off: m1 at "),
    ],
)
def test_one_that_fails_says_why(name: str, overrides: dict[str, object], says: str) -> None:
    found = premises(**overrides)[name]
    assert found.holds is False
    assert says in found.text


def test_unequal_scalars_of_kd_hold() -> None:
    found = premises(sites__m2__control__Kd=6.0)["Kd"]
    assert found.holds
    assert found.text == "one Kd but for a scalar: m1 1, m2 2, s 1"


def test_a_hand_that_holds_on_fails_a_premise() -> None:
    assert premises("paper", duration_s=3.0, rate_hz=100)["hands"].holds is False  # until 11 s
    lets_go = premises("paper", duration_s=12.5, rate_hz=100)["hands"]
    assert lets_go.holds
    assert "nobody pushes after 10.99" in lets_go.text
    briefly = premises("paper", duration_s=11.5, rate_hz=100)["hands"]
    assert briefly.holds is False
    assert "0.5 s of free motion at the end are less than 1 s" in briefly.text


def test_a_damper_of_qd_may_give_energy_to_r() -> None:
    hands = next(p for p in runs.run("wall").certificate.premises if p.name == "hands")
    assert hands.holds is False
    assert hands.text.startswith("the hands and walls gave up to")
