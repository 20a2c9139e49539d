"""A law from outside in a live session: the same bits; a failing law ends the session in order."""

from pathlib import Path
from typing import Any

import pytest

from sites.site_parts import warm_up
from tests.control_laws.law_settings import LAWS
from tests.energy_runs import FOLLOWER
from tests.sites.sessions import execute_packed, pack_log
from trilat_net.errors import LawFailed
from trilat_net.execution.verification import verify_log
from trilat_net.execution.virtual_comparison import compare_with_virtual
from trilat_net.log.log_reader import Log
from trilat_net.scenario import load_scenario

from .sessions import Session


def lived(folder: Path, name: str, **overrides: object) -> tuple[Log, dict[str, object]]:
    scenario = load_scenario(name, {"duration_s": 0.5, **overrides})
    session = Session.whole(scenario, folder, ends={})
    return session.run(), session.ends or {}


def test_own_paper_law_has_live_bits(tmp_path: Path) -> None:
    law = {"law": "tests.laws:Adaptive"}
    log, ends = lived(tmp_path, "two_sites", control=law)
    assert ends == {"m": 0, "s": 0}
    assert pack_log(log) == execute_packed(log.scenario)
    assert pack_log(log) == execute_packed(load_scenario("two_sites", {"duration_s": 0.5}))
    verdict = verify_log(log)
    assert verdict.whole_run
    assert verdict.identical == verdict.records == 1000


def test_law_messages_equal_those_of_virtual_time(tmp_path: Path) -> None:
    log, _ = lived(
        tmp_path, "paper", control={"law": "tests.channel_law:Talking"}, duration_s=0.3
    )
    assert pack_log(log) == execute_packed(log.scenario)
    assert verify_log(log).identical == 900
    assert log["m1"].sent["target[s]"].any()


ENERGY_LAWS: dict[str, tuple[str, dict[str, Any]]] = {
    "wave": ("two_sites", {f"sites.s.control.{key}": FOLLOWER[key] for key in FOLLOWER}),
    "tdpa": ("two_sites", {f"sites.s.control.{key}": FOLLOWER[key] for key in FOLLOWER}),
    "tanks": ("two_sites", {}),
}
"""Laws that keep account of energy."""


@pytest.mark.long
@pytest.mark.parametrize("law", [*LAWS, *ENERGY_LAWS])
def test_every_plugged_law_has_live_bits(law: str, tmp_path: Path) -> None:
    name, settings = {**LAWS, **ENERGY_LAWS}[law]
    digital = {"scheme": "digital"} if law in ENERGY_LAWS else {}
    keys = {"link.delay_ms": 20.0, "control.law": law, **digital, **settings}
    log, _ = lived(tmp_path, name, duration_s=0.3, **keys)
    assert pack_log(log) == execute_packed(log.scenario)
    assert verify_log(log).identical == 300 * len(log.sites)


@pytest.mark.parametrize("how", ["nan", "raises"])
def test_failing_laws_end_the_session_in_order(how: str, tmp_path: Path) -> None:
    control = {"law": "tests.laws:Failing", "how": how, "at": 250}
    log, ends = lived(tmp_path, "paper", **{"sites.m2.control": control})
    assert isinstance(ends["m2"], LawFailed)
    text = str(ends["m2"])
    assert text.startswith("the law tests.laws:Failing of m2 failed at tick 250: ")
    for other in ("m1", "s"):
        assert str(ends[other]) == f"{other} ended because {text}"
    assert log.complete
    assert [event.text for event in log.events if event.kind == "failed"] == [text]
    ticks_made = {event.member: event.ticks for event in log.events if event.kind == "end"}
    assert ticks_made["m2"] == len(log["m2"]) == 250
    for other in ("m1", "s"):
        assert 250 < ticks_made[other] == len(log[other]) < 500
    assert verify_log(log).passed
    twins = compare_with_virtual(log)
    assert twins.fed.first is None
    assert twins.fed.identical == sum(ticks_made.values())


def test_laws_failing_at_rest_are_found_beforehand() -> None:
    control = {"law": "tests.laws:Failing", "how": "nan", "at": 3}
    scenario = load_scenario("two_sites", {"sites.s.control": control})
    with pytest.raises(LawFailed, match=r"of s failed at tick 3: .* this was the rehearsal"):
        warm_up(scenario, "s")
