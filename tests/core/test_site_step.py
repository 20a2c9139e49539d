"""The step is pure, resumable, bounded, and finite for any input (L1, L3)."""

import math
import struct
import zlib

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.core.builders import VECTORS, describe_bits, make_arrival, make_site_setup, step_site
from tests.programs import run_python
from trilat_net.core.step.site_step import Site
from trilat_net.core.step.ticks import MAX_ARRIVALS, Arrival, Mode, TickInput, TickRecord
from trilat_net.errors import ScenarioError
from trilat_net.execution import virtual
from trilat_net.scenario import load_scenario


def is_finite(output: TickRecord) -> bool:
    return all(math.isfinite(v) for field in VECTORS for v in getattr(output, field))


arrivals = st.lists(
    st.builds(
        Arrival,
        st.integers(0, 1),
        st.integers(-1, 80),
        st.tuples(*[st.floats(-3, 3)] * 2),
        st.tuples(*[st.floats(-9, 9)] * 2),
    ),
    max_size=6,
)


@settings(max_examples=40)
@given(
    arrivals_by_tick=st.lists(arrivals, min_size=1, max_size=40),
    scheme=st.sampled_from(["second_order", "digital"]),
)
def test_equal_ticks_give_equal_bits(
    arrivals_by_tick: list[list[Arrival]], scheme: str
) -> None:
    ticks = [TickInput(k, c) for k, c in enumerate(arrivals_by_tick)]
    first, other = (
        Site(make_site_setup("m2", "free", scheme=scheme, link__delay_ms=7)) for _ in range(2)
    )
    assert [describe_bits(o) for o in step_site(first, ticks)] == [
        describe_bits(o) for o in step_site(other, ticks)
    ]


def test_records_hold_their_ticks_state_and_inputs() -> None:
    """Stage 7 emits before stage 8 advances; tau_x is the negative of the torque ON the arm,
    Eq.

    (8).
    """
    site = Site(
        make_site_setup(
            "m1", "paper", sites__m1__q0_rad=[0.3, -0.1], sites__m1__qd0_rad_s=[0.2, 0.4]
        )
    )
    first = site.step(TickInput(0))
    assert (first.q, first.qd, first.t_ns) == ([0.3, -0.1], [0.2, 0.4], 0)
    outputs = step_site(site, [TickInput(k) for k in range(1, 3501)])
    assert outputs[-1].tau_x == pytest.approx([-10.0, -10.0])
    assert outputs[10].tau_x == [0.0, 0.0]
    assert "-" not in str(outputs[10].tau_x)


_PROGRAM = """
from tests.core.builders import execute_as_text
for scheme in ("second_order", "digital"):
    keys = {"scheme": scheme, "duration_s": 0.25, "link__delay_ms": 20}
    records = execute_as_text("asymmetric", links={"m2->m1": {"delay_ms": 33.5}}, **keys)
    print("\\n".join(records))
"""


@pytest.mark.push
def test_uncompiled_runs_have_the_same_bits() -> None:
    plain = run_python(_PROGRAM, compiled=False)
    assert plain.count("\n") == 2 * 3 * 250
    assert plain == run_python(_PROGRAM, compiled=True)


@pytest.mark.parametrize("scheme", ["second_order", "digital"])
@pytest.mark.parametrize("k", [1, 2, 21, 150])
def test_two_records_resume_the_same_bits(scheme: str, k: int) -> None:
    """Every record is a key-frame: records k-2 and k-1 and the waiting samples of the links."""
    built = make_site_setup("m1", "free", scheme=scheme, link__delay_ms=20)
    ticks = [
        TickInput(n, [make_arrival(n - 1, peer) for peer in (0, 1)] if n else [])
        for n in range(200)
    ]
    whole = step_site(Site(built), ticks)
    site = Site(built)
    before = whole[max(0, k - 2)]
    last = whole[k - 1]
    in_use = [make_arrival(m, peer) if m >= 0 else None for peer, m in enumerate(last.used)]
    waiting = [
        make_arrival(m, peer) for peer, m in enumerate(last.used) for m in range(m + 1, k - 1)
    ]
    site.restore_links(k, in_use, waiting)
    site.restore_state(before, last)
    assert [describe_bits(o) for o in step_site(site, ticks[k:])] == [
        describe_bits(o) for o in whole[k:]
    ]


@pytest.mark.parametrize("name", ["asymmetric", "paper", "two_sites"])
def test_different_rates_meet_on_the_grid(name: str) -> None:
    """Any mix of rates runs; every site's samples in use are older than the delay by less than
    two periods.
    """
    scenario = load_scenario(name)
    rates = dict(zip(scenario.names, (1000, 450, 333), strict=False))
    changed = load_scenario(
        name, {f"sites.{n}.rate_hz": r for n, r in rates.items()} | {"duration_s": 1.0}
    )
    last: dict[str, TickRecord] = {}
    for site, _, output in virtual.execute_virtual(changed):
        last[site.name] = output
    for n, output in last.items():
        assert output.mode is Mode.RUN
        for peer, used in zip(changed.peers(n), output.used, strict=True):
            age_ns = output.t_ns - used * 10**9 // rates[peer]
            extra = age_ns - round(1e6 * changed.links[f"{peer}->{n}"].delay_ms)
            assert 0 <= extra <= 10**9 / rates[peer] + 1


def four_sites() -> dict[str, object]:
    names = ("a", "b", "c", "d")
    return {
        "sites": {n: {"q0_rad": [0.1 * i, -0.2 * i]} for i, n in enumerate(names)},
        "dominance": {i: {j: (1 / 3) for j in names if j != i} for i in names},
        "expect": {},
    }


def test_no_code_depends_on_three_sites() -> None:
    last = {
        site.name: o
        for site, _, o in virtual.execute_virtual(
            load_scenario("paper", {**four_sites(), "duration_s": 30.0})
        )
    }
    assert len(last) == 4
    assert all(o.used == [29_799] * 3 for o in last.values())
    poses = [o.q for o in last.values()]
    assert max(abs(a - b) for pose in poses for a, b in zip(pose, poses[0], strict=True)) < 0.02


@pytest.mark.parametrize("scheme", ["second_order", "digital"])
def test_the_torque_limit_is_applied(scheme: str) -> None:
    site = Site(make_site_setup("m1", "free", scheme=scheme, limits__tau_limit_nm=2.0))
    torques = [o.tau for o in step_site(site, [TickInput(k) for k in range(400)])]
    assert max(abs(t) for tau in torques for t in tau) == 2.0
    assert site.step(TickInput(400)).mode is Mode.RUN


def test_sites_beyond_their_speed_limit_diverge_once() -> None:
    site = Site(make_site_setup("m1", "free", limits__qd_limit_rad_s=0.5))
    outputs = step_site(site, [TickInput(k) for k in range(400)])
    k = next(o.tick for o in outputs if o.mode is Mode.DIVERGED)
    assert max(map(abs, outputs[k].qd)) > 0.5 >= max(map(abs, outputs[k - 1].qd))
    assert all(
        o.mode is Mode.DIVERGED and (o.q, o.qd) == (outputs[k].q, outputs[k].qd)
        for o in outputs[k:]
    )


def test_a_diverged_run_ends_at_once() -> None:
    ran = list(virtual.execute_virtual(load_scenario("free", {"limits.qd_limit_rad_s": 0.5})))
    assert ran[-1].output.t_ns == ran[-3].output.t_ns < 20 * 10**9
    assert any(r.output.mode is Mode.DIVERGED for r in ran[-3:])
    assert all(r.output.mode is Mode.RUN for r in ran[:-3])


extreme = st.sampled_from([1.7e308, -1.7e308, 1e200, -1e160, 5e-324, 0.0, 1.0])


@settings(max_examples=60)
@given(
    arriving=st.lists(st.tuples(extreme, extreme, extreme, extreme), min_size=1, max_size=20),
    Lambda=st.sampled_from([1.0, 5.0, 1e9]),
    scheme=st.sampled_from(["second_order", "digital"]),
)
def test_no_record_is_ever_infinite(
    arriving: list[tuple[float, float, float, float]], Lambda: float, scheme: str
) -> None:
    """Records are finite for any finite numbers of a peer and any gains."""
    site = Site(
        make_site_setup("m1", "paper", control__Lambda=Lambda, scheme=scheme, link__delay_ms=0)
    )
    for k, numbers in enumerate([None, *arriving, None, None]):
        numbers_of_tick = (
            [] if numbers is None else [Arrival(0, k - 1, numbers[:2], numbers[2:])]
        )
        assert is_finite(site.step(TickInput(k, numbers_of_tick)))


LARGEST = 1e9
"""The largest number that a scenario may hold."""


@pytest.mark.parametrize("scheme", ["second_order", "digital"])
@pytest.mark.parametrize(
    "key",
    [f"control.{gain}" for gain in ("Gamma", "Lambda", "theta_hat0", "Kp", "Kd")]
    + ["arm.g_m_s2", "sites.m1.q0_rad", "sites.m1.qd0_rad_s", "limits.tau_limit_nm"],
)
def test_absurd_scenarios_are_refused_or_stop_finite(key: str, scheme: str) -> None:
    with pytest.raises(ScenarioError, match=key.rpartition(".")[2]):
        load_scenario("paper", {key: 1e308})
    ran = list(
        virtual.execute_virtual(
            load_scenario("paper", {key: LARGEST, "scheme": scheme, "duration_s": 0.3})
        )
    )
    assert all(is_finite(r.output) for r in ran)


def test_too_many_arrivals_in_a_tick_are_refused() -> None:
    site = Site(make_site_setup())
    site.step(TickInput(0, [make_arrival(n) for n in range(MAX_ARRIVALS)]))
    with pytest.raises(ValueError, match="4096"):
        site.step(TickInput(1, [make_arrival(n) for n in range(MAX_ARRIVALS + 1)]))


def test_arrival_checksums_cover_their_bytes() -> None:
    """rx_crc: little-endian (peer i64, tick i64, q f64s, qd f64s) of each arrival."""

    arrivals_made = [
        Arrival(1, 5, (0.1, -0.0), (3.0, 4.0), 77),
        Arrival(0, 2, (1.0, 2.0), (0.5, 5e-324), 9),
    ]
    packed = b"".join(
        struct.pack("<qqdddd", a.peer, a.tick, *a.q, *a.qd) for a in arrivals_made
    )
    assert Site(make_site_setup()).step(TickInput(0, arrivals_made)).rx_crc == zlib.crc32(
        packed
    )
