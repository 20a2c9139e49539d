import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.theory.networks import Network, Wire, pair
from trilat_net.errors import UsageError
from trilat_net.theory.linear_loop import LinearLoop
from trilat_net.theory.port_passivity import clamp_ports
from trilat_net.theory.port_response import (
    CLAMPED,
    FREE,
    PortLoad,
    apply_loads,
    build_admittance,
)

W = np.geomspace(1e-2, 1e2, 41)
POSITIVE = st.floats(0.1, 10.0)
REFLECTING = Network(
    (1.0, 2.0, 1.5),
    (1.0, 2.0, 3.0),
    (0.0, 0.5, 0.0),
    (
        Wire(0, 1, 0.0, 0.0, 0.2, 0.7),
        Wire(1, 0, 9.0, 1.0, 0.3),
        Wire(2, 1, 4.0, 0.0, 0.1),
        Wire(0, 2, 2.0, 0.0, 0.1),
    ),
)


def same(a: LinearLoop, b: LinearLoop) -> None:
    np.testing.assert_allclose(build_admittance(a)(W), build_admittance(b)(W), rtol=1e-9)


@given(K=POSITIVE, B=POSITIVE)
def test_load_is_spring_and_damper_of_network(K: float, B: float) -> None:
    network = pair()
    tied = network._replace(k=(0.0, K), d=(network.d[0], network.d[1] + B))
    same(apply_loads(network.loop, {"b": PortLoad(K, B)}), tied.loop)


def test_a_free_load_changes_nothing() -> None:
    same(apply_loads(REFLECTING.loop, {"b": FREE}), REFLECTING.loop)


@given(K=POSITIVE, B=POSITIVE)
def test_a_loads_impedance_adds_at_its_port(K: float, B: float) -> None:
    Y = build_admittance(REFLECTING.loop)(W)
    load = np.diag([0.0, 1.0, 0.0]) * (B + K / (1j * W))[:, np.newaxis, np.newaxis]
    expected = np.linalg.inv(np.linalg.inv(Y) + load)
    np.testing.assert_allclose(
        build_admittance(apply_loads(REFLECTING.loop, {"b": PortLoad(K, B)}))(W), expected, rtol=1e-8
    )


@pytest.mark.parametrize("site", ["a", "b", "c"])
def test_a_clamp_leaves_the_rest_of_the_impedance(site: str) -> None:
    """Also where the clamp's own torque is reflected, and comes back by two delays."""
    place = "abc".index(site)
    keep = [n for n in range(3) if n != place]
    clamped = apply_loads(REFLECTING.loop, {site: CLAMPED})
    assert clamped.inputs == tuple(f"{name}.tau1" for name in "abc" if name != site)
    assert not any(name.startswith(f"{site}.") for name in clamped.names)
    Y = build_admittance(REFLECTING.loop)(W)
    np.testing.assert_allclose(
        build_admittance(clamped)(W), clamp_ports(Y, keep, [place]), rtol=1e-8, atol=1e-12
    )


def test_a_very_stiff_spring_is_nearly_a_clamp() -> None:
    stiff = build_admittance(apply_loads(REFLECTING.loop, {"b": PortLoad(1e9)}))(W)[:, [0, 2]][:, :, [0, 2]]
    np.testing.assert_allclose(
        stiff, build_admittance(apply_loads(REFLECTING.loop, {"b": CLAMPED}))(W), rtol=1e-5, atol=1e-7
    )


def test_clamps_that_reflect_onto_each_other_are_refused() -> None:
    both = Network(
        (1.0, 1.0),
        (1.0, 1.0),
        (0.0, 0.0),
        (Wire(0, 1, 1.0, k_f=0.5, delay_s=0.1), Wire(1, 0, 1.0, k_f=0.5, delay_s=0.1)),
    )
    three = Network((1.0,) * 3, (1.0,) * 3, (0.0,) * 3, both.wires)
    assert len(apply_loads(three.loop, {"a": CLAMPED}).inputs) == 2
    with pytest.raises(UsageError, match="reflect force onto each other"):
        apply_loads(three.loop, {"a": CLAMPED, "b": CLAMPED})


@pytest.mark.parametrize(
    ("site", "load", "said"),
    [
        ("z", FREE, "no site 'z' at the ports; there are a, b"),
        ("a", PortLoad(-1.0), "at least 0"),
        ("a", PortLoad(1.0, -1.0), "at least 0"),
        ("a", PortLoad(1.0, math.inf), "at least 0"),
        ("a", PortLoad(math.nan), "at least 0"),
    ],
)
def test_what_is_no_load_is_refused(site: str, load: PortLoad, said: str) -> None:
    with pytest.raises(UsageError, match=said):
        apply_loads(pair().loop, {site: load})
