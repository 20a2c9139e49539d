"""A policy and a person in real processes of a session, through the interfaces of LeRobot."""

import threading

import pytest
from lerobot_tests.driving import assert_taken_over, drive
from lerobot_tests.lerobot_stub import plugins

import trilat_net

from .processes import PAPER, Session, Stage


@pytest.mark.long
def test_a_person_takes_over_from_a_policy_live(
    stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The log of both is verified, and is repeated in virtual time."""
    monkeypatch.setenv("HF_HOME", str(stage.folder))
    session = Session(stage, "play", PAPER, "--duration", "8")
    session.all()
    session.begun()
    session.recording()
    running = trilat_net.session("t", connect=session.endpoints)
    reach = {
        "session": "t",
        "scenario": "play",
        "connect": session.endpoints,
        "timeout_s": 60.0,
    }
    with plugins() as plugin_classes:
        seen = drive(plugin_classes, running, threading.Event().wait, **reach)
    assert_taken_over(seen, session.is_reproduced())
