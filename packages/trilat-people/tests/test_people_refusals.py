"""Experiments and other requests of `trilat-people` that are refused."""

from pathlib import Path
from typing import Any

import msgspec
import pytest
from trilat_people.experiment.protocol import ExperimentPlan, ExperimentProtocol

import trilat_net as tn
from tests.experiments import write_protocol
from tests.refusals.corpus import Case, parametrize_cases
from trilat_net.errors import UsageError

PROTOCOL = {
    "name": "study",
    "scenario": "paper",
    "set": {"sites.m1.hands": [{"kind": "live"}], "sites.m2.hands": [{"kind": "live"}]},
    "conditions": {"near": {"link.delay_ms": 0}, "far": {"link.delay_ms": 300}},
    "participants": 4,
}
"""A protocol that can be planned."""
STAIRCASE = '\n[staircase]\nkey = "control.K"\nstandard = 100.0\nstart = 80.0\n'


class ProtocolCase(Case, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A protocol of an experiment: a text, a valid protocol with changes, or a missing file."""

    keys: dict[str, Any] = msgspec.field(default_factory=dict)
    """Changed keys of `PROTOCOL`."""
    text: str = ""
    replace: str = ""
    """Part of a valid protocol with a staircase, which `by` replaces."""
    by: str = ""

    def plan(self, folder: Path) -> object:
        """Returns the plan of the protocol, unless the protocol is refused."""
        if self.keys:
            return ExperimentPlan.of_protocol(
                msgspec.convert({**PROTOCOL, **self.keys}, ExperimentProtocol)
            )
        if not self.replace:
            file = folder / "protocol.toml"
            if self.text:
                file.write_text(self.text, encoding="utf-8")
            return tn.check_experiment(file)
        file = write_protocol(folder, task='kind = "track"\nduration_s = 0.2', more=STAIRCASE)
        text = file.read_text(encoding="utf-8").replace(
            "trials = 2", "trials = 2\npractice = 1"
        )
        assert self.replace in text, self.name
        file.write_text(text.replace(self.replace, self.by), encoding="utf-8")
        return tn.check_experiment(file)


@parametrize_cases("protocols.toml", ProtocolCase)
def test_impossible_experiments_are_refused(case: ProtocolCase, tmp_path: Path) -> None:
    with pytest.raises(UsageError) as caught:
        case.plan(tmp_path)
    case.check_message(str(caught.value), caught.value.exit_code)
