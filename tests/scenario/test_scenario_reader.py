"""Scenarios: every loaded scenario runs, and every key has its value in the run."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from trilat_net.core.arms.exogenous import TorqueKind, TorqueSource
from trilat_net.core.links.delay import LinkModel
from trilat_net.core.step.site_setup import Gains, Law, StaleAction, StaleRule
from trilat_net.errors import ScenarioError
from trilat_net.scenario import list_shipped, load_scenario, parse_scenario, read_template
from trilat_net.scenario.override import ScenarioOverrides
from trilat_net.scenario.scenario_reader import read_shipped


@pytest.mark.parametrize("name", list_shipped())
def test_shipped_scenarios_are_called_by_name(name: str) -> None:
    scenario = load_scenario(name)
    assert scenario.name == name
    assert scenario.title
    assert scenario.assumed
    assert scenario.beta is not None
    assert [scenario.setup(site).name for site in scenario.names] == list(scenario.names)


def test_paper_is_section_iv() -> None:
    scenario = load_scenario("paper")
    assert (scenario.duration_s, scenario.scheme) == (20.0, "second_order")
    assert {link.delay_ms for link in scenario.links.values()} == {200.0}
    assert scenario.alpha.tolist() == [[0.0, 0.5, 0.5], [0.5, 0.0, 0.5], [0.5, 0.5, 0.0]]
    m1 = scenario.setup("m1")
    assert m1.theta.tolist() == [3.0, 1.0, 1.0, 2.0, 1.0]
    assert m1.actors == (TorqueSource(TorqueKind.PULSE, 1.0, 6.0, a=(10.0, 10.0)),)
    assert m1.gains == Gains(Law.ADAPTIVE, (1, 1), (1, 1), (3, 3), (1,) * 5, (0,) * 5)
    assert [link.peer for link in m1.links] == ["m2", "s"]
    assert m1.links[0].models == (LinkModel(location=200_000.0),)


def test_templates_are_valid_with_their_defaults() -> None:
    scenario = parse_scenario(read_template(), "template")
    assert scenario.name == "mine"
    spelt_out = "\n".join(
        line.removeprefix("# ") for line in read_template().splitlines() if "=" in line
    )
    assert "Kd = 3.0" in spelt_out
    control = scenario.sites["m1"].control
    assert (control.Kd, control.Gamma) == ((3.0, 3.0), (1.0,) * 5)
    assert scenario.sites["s"].limits.tau_limit_nm == 200.0


def test_hashes_name_experiments() -> None:
    hashes = [load_scenario("paper").sha256, load_scenario("free").sha256]
    hashes += [
        load_scenario("paper", {key: 2}).sha256
        for key in ("seed", "control.Kd", "arm.m1_kg", "link.delay_ms")
    ]
    assert len(set(hashes)) == len(hashes)
    assert load_scenario("paper", {"control.Kd": 3}).sha256 == load_scenario("paper").sha256


# Overrides and defaults.


def test_an_override_reads_key_equals_value() -> None:
    tables: dict[str, Any] = {}
    texts = [
        "control.Kd=5",
        "scheme=digital",
        "sites.m1.q0_rad=[0.1, 2]",
        'title="a = b"',
        "seed = 7",
    ]
    ScenarioOverrides.parse(texts).apply_to(tables)
    assert tables == {
        "control": {"Kd": 5},
        "scheme": "digital",
        "sites": {"m1": {"q0_rad": [0.1, 2]}},
        "title": "a = b",
        "seed": 7,
    }


def test_kind_overrides_replace_other_kinds() -> None:
    """In any order of keys; other overrides of the same table stay."""
    for texts in (["link.preset=4g", "link.loss=0.1"], ["link.loss=0.1", "link.preset=4g"]):
        links = load_scenario("paper", texts).links.values()
        assert {link.describe() for link in links} == {
            "hyperexponential 53 +- 87.8 ms, loss 10 %"
        }
    assert load_scenario("paper", ["link.model=measured"]).measured
    assert (
        load_scenario("4g", ["link.delay_ms=5", "link.model=constant"])
        .links["m1->s"]
        .describe()
        == "5 ms"
    )


def test_law_overrides_take_that_laws_gains() -> None:
    scenario = load_scenario("paper", ["control.law=p_d", "control.d=7"])
    gains = scenario.setup("m1").gains
    assert (gains.law, gains.K, gains.d) == (Law.KNOWN, (10.0, 10.0), (7.0, 7.0))
    mixed = load_scenario("paper", {"sites.s.control": {"law": "p_d"}})
    assert [mixed.setup(name).gains.law for name in mixed.names] == [
        Law.ADAPTIVE,
        Law.ADAPTIVE,
        Law.KNOWN,
    ]


def test_rules_for_stale_peers_are_read() -> None:
    assert load_scenario("paper").setup("s").on_stale == StaleRule(
        StaleAction.USE, 350_000_000, 1_000_000_000
    )
    keys = {
        "on_stale": {"action": "hold", "age_ms": 120.5},
        "sites.s.on_stale": {"action": "brake"},
    }
    scenario = load_scenario("paper", {**keys, "link.delay_ms": 100.0})
    assert scenario.setup("m1").on_stale == StaleRule(
        StaleAction.HOLD, 120_500_000, 1_000_000_000
    )
    assert scenario.setup("s").on_stale == StaleRule(
        StaleAction.BRAKE, 120_500_000, 1_000_000_000
    )


def test_overrides_reach_list_entries_by_number() -> None:
    wall = load_scenario("contact").sites["s"].environment[0]
    stiff = load_scenario(
        "contact", ["sites.s.environment.0.stiffness_n_m=500", "sites.s.q0_rad.1=0.5"]
    )
    assert stiff.sites["s"].environment == (msgspec.structs.replace(wall, stiffness_n_m=500.0),)
    assert stiff.sites["s"].q0_rad == (load_scenario("contact").sites["s"].q0_rad[0], 0.5)
    assert stiff.sites["m"].hands == load_scenario("contact").sites["m"].hands
    resolved = load_scenario(
        load_scenario("contact"),
        {"sites.s.environment.0.stiffness_n_m": 500, "sites.s.q0_rad.1": 0.5},
    )
    assert resolved == stiff
    tables: dict[str, Any] = {"a": [{"b": [1, 2]}, {}]}
    ScenarioOverrides.parse(["a.0.b.1=5", "a.1.c=6"]).apply_to(tables)
    assert tables == {"a": [{"b": [1, 5]}, {"c": 6}]}


def test_single_numbers_apply_to_all_joints() -> None:
    control = load_scenario("paper", {"control.Kd": 5, "control.Gamma": 0.5}).sites["s"].control
    assert control.Kd == (5.0, 5.0)
    assert control.Gamma == (0.5,) * 5
    scenario = load_scenario("paper", {"sites.m1.q0_rad": 0.25, "sites.m1.control.Kp": [2, 3]})
    assert scenario.sites["m1"].q0_rad == (0.25, 0.25)
    assert scenario.sites["m1"].control.Kp == (2.0, 3.0)
    assert scenario.sites["m2"].control.Kp == (1.0, 1.0)


def test_sites_and_links_override_their_groups() -> None:
    scenario = load_scenario(
        "paper",
        {
            "sites.s.arm.m1_kg": 2,
            "links": {"m1->s": {"delay_ms": 350.0}},
            "sites.m2.rate_hz": 500,
        },
    )
    assert scenario.sites["s"].arm.m1_kg == 2.0
    assert scenario.sites["m1"].arm.m1_kg == 1.0
    assert [link.models[0].location for link in scenario.setup("s").links] == [
        350_000.0,
        200_000.0,
    ]
    setup = scenario.setup("m1")
    assert [link.models[0].location for link in setup.links] == [200_000.0, 200_000.0]
    assert [link.rate_hz for link in setup.links] == [500, 1000]


def test_a_delay_is_rounded_to_whole_microseconds() -> None:
    for delay_ms, us in ((0.0004, 0.0), (0.0006, 1.0), (199.0011, 199_001.0)):
        assert (
            load_scenario("paper", {"link.delay_ms": delay_ms})
            .setup("m1")
            .links[0]
            .models[0]
            .location
            == us
        )


def test_without_hands_the_experiment_is_free() -> None:
    scenario = load_scenario("paper").without_hands()
    assert all(spec.hands == () for spec in scenario.sites.values())
    assert scenario.setup("m1").actors == ()
    assert scenario.sites["m1"].control == load_scenario("paper").sites["m1"].control


def test_unnamed_shares_are_zero() -> None:
    scenario = load_scenario("paper", {"dominance.m1": {"s": 1}})
    assert scenario.alpha[0].tolist() == [0.0, 0.0, 1.0]
    assert scenario.beta is not None


def test_reducible_matrices_have_no_beta() -> None:
    """Expert and slave locked, trainee following: the scenario runs, and only the certificate
    is without weights.
    """
    rows = {"m1": {"s": 1}, "m2": {"m1": 0.5, "s": 0.5}, "s": {"m1": 1}}
    assert load_scenario("paper", {"dominance": rows}).beta is None
    assert np.allclose(load_scenario("asymmetric").beta, [0.426, 0.155, 0.419], atol=5e-4)


def test_two_sites_and_delays_suffice() -> None:
    text = 'name = "a"\n[link]\ndelay_ms = 3\n[sites.a]\n[sites.b]\n[dominance]\na = { b = 1 }\nb = { a = 1 }'
    scenario = parse_scenario(text)
    assert (scenario.duration_s, scenario.sites["a"].rate_hz) == (20.0, 1000)


def test_files_are_read_by_path(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(read_template(), encoding="utf-8")
    assert load_scenario(path) == load_scenario(str(path)) == parse_scenario(read_template())
    scenario = load_scenario(path)
    assert load_scenario(scenario) is scenario
    assert load_scenario(scenario, {"seed": 5}).seed == 5


def test_unreadable_files_are_refused(tmp_path: Path) -> None:
    latin = tmp_path / "latin.toml"
    latin.write_bytes("title = 'Stärke'".encode("latin-1"))
    for path, reason in (
        (tmp_path / "none.toml", "No such file"),
        (tmp_path, "is a folder"),
        (latin, "not UTF-8"),
    ):
        with pytest.raises(ScenarioError, match=reason) as error:
            load_scenario(path)
        assert str(path) in str(error.value)


def test_a_stale_rule_above_the_delay_is_accepted() -> None:
    """Without an action, the age may lie below the delay, because nothing follows from the age."""
    changes = {"on_stale.action": "hold", "on_stale.age_ms": 350.0, "link.delay_ms": 349.0}
    assert load_scenario("paper", changes).sites["s"].on_stale.action == "hold"
    load_scenario("paper", {"on_stale.age_ms": 1.0})


FIRST_READERS = """
import os, sys, threading
from trilat_net.scenario import load_scenario

def read(together):
    together.wait()
    load_scenario("play")

sys.setswitchinterval(1e-6)
for _ in range(8):
    if not (child := os.fork()):
        together = threading.Barrier(4)
        threads = [threading.Thread(target=read, args=(together,)) for _ in range(4)]
        [thread.start() for thread in threads]
        [thread.join() for thread in threads]
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0
"""


def test_threads_may_be_the_first_readers_together() -> None:
    """A program that opens two hands at once reads one scenario in two threads."""
    assert (
        subprocess.run(
            [sys.executable, "-c", FIRST_READERS], check=False, timeout=60
        ).returncode
        == 0
    )


@pytest.mark.parametrize("table", ["arm", "sites.m.arm"])
@pytest.mark.parametrize("content", ["", "<robot", "<robot name='r'/>"])
def test_errors_of_urdf_files_name_the_written_table(
    table: str, content: str, tmp_path: Path
) -> None:
    """A file that cannot be read or used is named by the table in which its name stands."""
    text = read_shipped("two_sites")
    if content:
        (tmp_path / "mine.urdf").write_text(content, encoding="utf-8")
    with pytest.raises(ScenarioError) as caught:
        parse_scenario(text, "", {f"{table}.urdf": "mine.urdf"}, tmp_path)
    assert caught.value.path == f"{table}.urdf"
