"""Logs for reruns, and the results of a rerun for each tick."""

import io
from collections.abc import Collection, Mapping
from typing import Any

import pytest

from tests.execution.deliveries import TICKS
from tests.log_editing import SHORT, edited, opened, recorded
from trilat_net.core.step.ticks import PlantState
from trilat_net.execution import virtual
from trilat_net.execution.what_if import Rerun
from trilat_net.log.log_reader import Log
from trilat_net.net.messages import STATE_VECTORS, State
from trilat_net.scenario import load_scenario

OTHER_PLATFORM = {"fingerprint": "0" * 16}


def numbers(state: State) -> list[list[float]]:
    """Returns all results of a tick except the arrivals."""
    return [
        *(getattr(state, field) for field in STATE_VECTORS),
        list(state.used.values()),
        state.mem,
    ]


def motion(log: Log, site: str) -> list[tuple[int, str, list[list[float]]]]:
    """Returns every tick of a site with its mode and numbers."""
    return [(state.tick, state.mode, numbers(state)) for state in log[site].states]


def simulated(name: str, overrides: Mapping[str, Any]) -> Log:
    """Returns a virtual run, by the plain driver."""
    stream = io.BytesIO()
    virtual.write_virtual_log(load_scenario(name, overrides), stream)
    return opened(stream.getvalue())


def without_records(
    lost: Mapping[str, Collection[int]],
    data: bytes | None = None,
    session: dict[str, str] | None = None,
) -> Log:
    """Returns a short log that lacks some records."""

    def record(r: dict[str, Any]) -> dict[str, Any] | None:
        return None if r["tick"] in lost.get(r["site"], ()) else r

    return opened(
        edited(recorded("paper") if data is None else data, record=record, session=session)
    )


def all_identical(again: Rerun) -> bool:
    """True if every executed record of every site has the bits of the log."""
    return all(
        effect.identical == effect.executed == len(again.before[name]) and effect.first is None
        for name, effect in again.sites.items()
    )


def external_log() -> bytes:
    """Returns a log like that of a live session with an external arm: no model here computes
    the motion of s.
    """
    outside = {"sites.s.plant": "external", "sites.s.arm.known": False}
    scenario = load_scenario("two_sites", dict(SHORT) | outside)
    moves = {k: PlantState([0.01 * k, -0.3], [0.25 * (k % 3), 1e-3 * k]) for k in range(TICKS)}
    stream = io.BytesIO()
    run = virtual.execute_virtual
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            virtual, "execute_virtual", lambda s, n=None, **_: run(s, n, measured={"s": moves})
        )
        patch.setattr(virtual, "check_virtual", lambda *_, **__: None)
        virtual.write_virtual_log(scenario, stream)
    return stream.getvalue()
