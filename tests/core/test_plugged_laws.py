"""Laws plugged into a tick: their inputs and messages; the compiled form has the bits of the plain form."""

import csv
import math
import operator
import re
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import trilat_net
from tests.execution.builders import run_fused
from trilat_net.core.plug.law_channel import LawChannel, SentVector
from trilat_net.core.plug.user_law import LawVector
from trilat_net.core.step.site_step import Site
from trilat_net.core.step.ticks import Arrival, TickInput, TickRecord
from trilat_net.errors import LawFailed, ScenarioError
from trilat_net.scenario import Scenario, load_scenario

ROOT = Path(__file__).parents[2]
TICKS = 60


def make_law_scenario(law: str, name: str = "asymmetric", **more: Any) -> Scenario:
    return load_scenario(name, {"link.delay_ms": 5.0, "control.law": law, **more})


def run_by_hand(scenario: Scenario, ticks: int = TICKS) -> dict[str, list[TickRecord]]:
    """Runs ticks in which every sample arrives at the next tick, with the receiver's part of `ch`."""
    setups = {name: scenario.setup(name) for name in scenario.names}
    sites = {name: Site(setup) for name, setup in setups.items()}
    records: dict[str, list[TickRecord]] = {name: [] for name in sites}
    for k in range(ticks):
        for name, site in sites.items():
            arrivals = []
            for j, link in enumerate(setups[name].links if k else ()):
                r = records[link.peer][k - 1]
                part = link.channel.select_for_peer(r.ch, link.index_at_peer)
                arrivals.append(Arrival(j, k - 1, r.q, r.qd, 0, r.tau_x, part))
            records[name].append(site.step(TickInput(k, arrivals)))
    return records


def test_compiled_laws_give_the_plain_bits() -> None:
    a, b = (
        run_by_hand(make_law_scenario(f"tests.plugged_laws:{law}"))
        for law in ("Line", "CompiledLine")
    )
    assert a == b
    last = a["s"][-1]
    assert last.ch[0] != 0.0  # the energy, then what each of the two masters gets
    assert len(last.ch) == 1 + 2 * 2
    assert last.mem[-1] == TICKS


class Watching:
    """A law that keeps its inputs and follows nobody."""

    remembers = ()
    needs_model = True

    def __init__(self, _facts: Any) -> None:
        self.seen: list[Any] = []

    def torque(self, now: Any) -> None:
        self.seen.append(now)
        for i in range(now.joints):
            now.tau[i] = 3.0 * (i + 1) + now.k


def test_laws_see_peers_external_torque_and_past() -> None:
    pulse = {"kind": "pulse", "start_s": 0.004, "end_s": 0.015, "peak_nm": [2.0, -1.0]}
    scenario = make_law_scenario("tests.laws:Adaptive", "free", **{"sites.m1.hands": [pulse]})
    laws: list[Watching] = []
    setup = scenario.setup("m1")._replace(
        law_factory=lambda facts: laws.append(Watching(facts)) or laws[-1]
    )
    site = Site(setup)
    records = []
    for k in range(20):
        arrived = (
            [Arrival(1, k - 1, (0.1 * k, 0.2), (0.3, 0.4), 0, (0.5, -0.6))]
            if k % 4 == 3
            else []
        )
        records.append(site.step(TickInput(k, arrived)))
    for k, now in enumerate(laws[0].seen):
        peer = now.peers[1]
        released = [m for m in range(2, 20, 4) if m + 5 <= k]  # 5 ms are 5 ticks
        assert peer.tick == (released[-1] if released else -1)
        assert peer.new == (k - 5 in released)
        assert peer.age_s == pytest.approx(1e-3 * (k - max(peer.tick, 0)), abs=1e-15)
        assert peer.tau_x == ([0.5, -0.6] if released else [0.0, 0.0])
        assert now.tau_x == records[k].tau_x
        before = records[k - 1] if k else None
        assert now.tau_before == (before.tau if before else [0.0, 0.0])
        assert now.q_before == (before.q if before else list(setup.q0))
        assert now.peers[0].tick == -1
    assert any(now.tau_x != [0.0, 0.0] for now in laws[0].seen)
    now = laws[0].seen[7]
    th1, th2, th3, th4, th5 = setup.theta
    c2 = math.cos(now.q[1])
    s2 = math.sin(now.q[1])
    outer = setup.g_m_s2 * th5 * math.cos(now.q[0] + now.q[1])
    gravity = [setup.g_m_s2 * th4 * math.cos(now.q[0]) + outer, outer]
    h = th2 * s2
    v, w = now.qd
    np.testing.assert_allclose(now.gravity, gravity, rtol=1e-12)
    np.testing.assert_allclose(
        now.inertia, [[th1 + 2 * th2 * c2, th3 + th2 * c2], [th3 + th2 * c2, th3]]
    )
    coriolis = [-h * (2 * v * w + w * w), h * v * v]
    np.testing.assert_allclose(now.bias, np.add(gravity, coriolis), rtol=1e-12)


class Torques:
    """A law that holds its arm by a spring, and keeps the torques that it sees."""

    seen: ClassVar[dict[str, list[Any]]] = {}

    def __init__(self, facts: trilat_net.LawContext) -> None:
        self._seen = self.seen.setdefault(facts.site, [])

    def torque(self, now: trilat_net.LawInput) -> Any:
        self._seen.append(now)
        return now.gravity - 50.0 * now.q - 20.0 * now.qd


def _read_signs() -> dict[str, float]:
    """Returns the sign that the pages give a torque: -1 if they call it minus a torque ON an arm."""
    signs = {}
    with (ROOT / "docs/data/law-inputs.csv").open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            if row["field"] in ("tau_x", "felt"):
                text = row["meaning"]
                assert " ON " in text
                signs[f"{row['object']}.{row['field']}"] = -1.0 if "minus" in text else 1.0
    page = (ROOT / "docs/extend/own-controller.md").read_text(encoding="utf-8")
    for field in ("tau_x", "felt"):
        (text,) = re.findall(rf"^\| `now\.{field}` \|.*", page, re.MULTILINE)
        assert " ON " in text
        assert signs[f"LawInput.{field}"] == (-1.0 if "| minus" in text else 1.0)
    return signs


def test_torques_have_the_documented_signs() -> None:
    """The operator of m1 pushes with a constant 2 and 3 N m ON its arm; no other hand acts."""
    push = np.array([2.0, 3.0])
    Torques.seen.clear()
    run = trilat_net.simulate(
        "free",
        {
            "control.law": Torques,
            "link.delay_ms": 5.0,
            "sites.m1.hands": [
                {"kind": "recorded", "points": [[0.0, 2.0, 3.0], [9.0, 2.0, 3.0]]}
            ],
        },
        duration_s=0.1,
    )
    signs = _read_signs()
    now = Torques.seen["m1"][50]
    assert now.tau_x == (signs["LawInput.tau_x"] * push).tolist()
    assert now.felt == [0.0, 0.0]
    now = Torques.seen["s"][50]
    assert now.tau_x == [0.0, 0.0]
    (pusher,) = [peer for peer in now.peers if any(peer.tau_x)]
    assert pusher.tau_x == (signs["peer.tau_x"] * push).tolist()
    np.testing.assert_allclose(now.felt, signs["LawInput.felt"] * pusher.alpha * push)
    # The push is positive: it moves the arm to larger angles than those of a run without it.
    free = trilat_net.simulate(
        "free",
        {"control.law": Torques, "link.delay_ms": 5.0, "sites.m1.hands": []},
        duration_s=0.1,
    )
    assert run["m1"].q[-1].sum() > free["m1"].q[-1].sum()


def test_names_of_several_senders_are_joined() -> None:
    a = LawChannel((SentVector("E", "J", 1), SentVector("u", "", 2, True)), 2)
    b = LawChannel((SentVector("F", "N m", 2), SentVector("E", "J", 1)), 2)
    vectors = LawChannel.join_received([a, b])
    assert [vector.name for vector in vectors] == ["E", "u", "F"]
    assert a.find_columns(vectors) == [0, 1, 2, -1, -1]
    assert b.find_columns(vectors) == [2, -1, -1, 0, 1]
    with pytest.raises(ValueError, match="E with different lengths, 1 and 3 numbers"):
        LawChannel.join_received([a, LawChannel((SentVector("E", "J", 3),), 2)])


REFUSED = {
    "CallsPlain": r"the law uses plain \(line \d+\), which is neither a number nor a function with @tri",
    "CallsMethod": "the law calls the method self.double: use a function with @trilat_net.compiled",
    "ReadsText": "self.name is of type str, but must be a number, or a list of numbers of fixed length",
    "ReadsNothing": "self.gain does not exist, but must be a number",
    "MakesList": r"the law creates an array or a list \(line \d+\): compute number by number, as in now",
    "Returns": "torque returns a value, but a compiled law must write the torque to now.tau instead",
    "RemembersText": "the attribute name, which the law keeps from tick to tick, must be a number",
}


@pytest.mark.parametrize("law", REFUSED)
def test_code_unsuitable_for_numba_is_refused(law: str) -> None:
    with pytest.raises(ScenarioError, match=REFUSED[law]) as caught:
        Site(make_law_scenario(f"tests.plugged_laws:{law}", "two_sites").setup("s"))
    assert caught.value.path == "sites.s.control.law"


def test_a_law_may_lack_memory_with_vectors() -> None:
    whole, parts = (
        trilat_net.simulate(
            "two_sites", {"control.law": f"tests.plugged_laws:{law}"}, duration_s=0.2
        )
        for law in ("Arithmetic", "ByNumbers")
    )
    for site in whole:
        assert np.array_equal(whole[site].q, parts[site].q)
        assert np.array_equal(whole[site].tau, parts[site].tau)
    assert trilat_net.verify(whole, resume_every=20).passed


@pytest.mark.parametrize("law", ["Sums", "SumsEach"])
def test_a_law_with_memory_is_recognised(law: str) -> None:
    with pytest.raises(
        ScenarioError, match=rf"{law} writes self.sums: .* remembers = \('sums',\)"
    ):
        Site(make_law_scenario(f"tests.plugged_laws:{law}", "two_sites").setup("s"))


NUMBERS = st.lists(st.floats(-1e3, 1e3), min_size=3, max_size=3)


@given(NUMBERS, NUMBERS, st.floats(0.1, 10.0))
def test_arithmetic_of_vectors_is_that_of_arrays(
    a: list[float], b: list[float], x: float
) -> None:
    for operate in (operator.add, operator.sub, operator.mul):
        expected = operate(np.array(a), np.array(b))
        for left, other in ((LawVector(a), LawVector(b)), (LawVector(a), b), (a, LawVector(b))):
            if LawVector in (type(left), type(other)) and (type(left), operate) != (
                list,
                operator.mul,
            ):
                assert operate(left, other) == expected.tolist()
        assert np.array_equal(operate(LawVector(a), np.array(b)), expected)
        assert np.array_equal(operate(np.array(a), LawVector(b)), expected)
        assert operate(LawVector(a), x) == operate(np.array(a), x).tolist()
        assert operate(x, LawVector(a)) == operate(x, np.array(a)).tolist()
    assert LawVector(a) / x == (np.array(a) / x).tolist()
    assert -LawVector(a) == [-number for number in a]
    total = LawVector(a)
    total += b
    total *= 2
    assert total == (2 * (np.array(a) + np.array(b))).tolist()


def test_missing_vector_arithmetic_names_the_alternative() -> None:
    for law, fact in (
        ("Squares", "as in numpy.asarray"),
        ("Mismatched", "cannot combine a vector of 2 numbers with a vector of 3"),
    ):
        with pytest.raises(LawFailed, match=fact):
            trilat_net.simulate(
                "two_sites", {"control.law": f"tests.plugged_laws:{law}"}, duration_s=0.1
            )


FAILING = {
    "Forgets": (3, r"torque\[0\] must be a finite number, but is nan"),
    "BeyondEnd": (2, "IndexError: index is out of bounds"),
}


@pytest.mark.parametrize("law", FAILING)
def test_failing_compiled_laws_name_their_tick(law: str) -> None:
    site = Site(make_law_scenario(f"tests.plugged_laws:{law}", "two_sites").setup("s"))
    tick, problem = FAILING[law]
    for k in range(tick):
        site.step(TickInput(k))
    with pytest.raises(LawFailed, match=f"{law} of s failed at tick {tick}: {problem}"):
        site.step(TickInput(tick))


@pytest.mark.long
def test_chain_laws_have_equal_bits_everywhere() -> None:
    """The law uses inertia, bias and gravity."""
    scenarios = [
        make_law_scenario(f"tests.plugged_laws:{law}", "six_joints")
        for law in ("Line", "CompiledLine")
    ]
    # soon after that the arms diverge
    a, b = (run_by_hand(scenario, 30) for scenario in scenarios)
    assert a == b
    for scenario in scenarios:
        fused = run_fused(scenario, 0.03)
        for name, row in zip(scenario.names, fused.records, strict=True):
            fields = scenario.layout(name).columns()
            assert row.tolist() == [
                number for field in fields for number in getattr(a[name][-1], field)
            ]
