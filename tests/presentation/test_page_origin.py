"""The commands of a report repeat its run, also if its control law is a user's file."""

import re
import shlex

import pytest

import trilat_net
from tests.own_laws import PD
from trilat_net.analysis.file_overview import summarise_run
from trilat_net.presentation.page_origin import render_origin


@pytest.mark.parametrize(
    ("law", "options"), [(PD, ["--law", "tests/own_laws.py"]), ("p_d", [])]
)
def test_commands_permit_exactly_the_laws_of_users(law: object, options: list[str]) -> None:
    log = trilat_net.simulate("p_d_margin_two", {"control.law": law}, duration_s=0.1)
    page = str(render_origin(log, summarise_run(log), ""))
    commands = [shlex.split(line) for line in re.findall(r"trilat verify [^<\n]*", page)]
    assert [command[:2] for command in commands] == [["trilat", "verify"]] * 2
    arguments = [[word for word in command[2:] if word != "--virtual"] for command in commands]
    assert [command[1:] for command in arguments] == [options] * 2
    assert ("--law" in page) == bool(options)
    assert ("in the folder from which the code is imported" in page) == bool(options)
