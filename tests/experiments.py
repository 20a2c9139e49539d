"""A short experiment of synthetic participants, as a protocol."""

from pathlib import Path
from typing import Any

from trilat_people.experiment.experiment_run import Experiment, Note

TEXT = """
name = "short"
scenario = "paper"
users = {users}
participants = 2
design = "{design}"
trials = 2
foreperiod_s = [0.2, 0.3]
[set]
rate_hz = 250
control = {{ law = "p_d", K = 100.0, d = 40.0 }}
sites.m1.q0_rad = [-0.6, 1.2]
sites.m1.hands = [{{ kind = "live", stiffness_n_m = 1000.0, damping_n_s_m = 100.0 }}]
sites.m2.q0_rad = [-0.6, 1.2]
sites.m2.hands = [{{ kind = "live", stiffness_n_m = 1000.0, damping_n_s_m = 100.0 }}]
sites.s = {{ q0_rad = [-0.6, 1.2] }}
dominance.m1 = {{ m2 = 0.2, s = 0.8 }}
dominance.m2 = {{ m1 = 0.2, s = 0.8 }}
dominance.s = {{ m1 = 0.7, m2 = 0.3 }}
[conditions.near]
"link.delay_ms" = 0
[conditions.far]
"link.delay_ms" = 200
[task]
{task}
"""
REACH = 'kind = "reach"\ntargets = 4\ndistance_m = 0.1\nwidth_m = 0.05\ntimeout_s = 6.0\ndwell_s = 0.2'
HANDOVER = f"{REACH}\nhandover_s = 3.0"
CONTACT = 'kind = "contact"\ndistance_m = 0.04\nforce_n = 4.0'
APART = 'kind = "track"\nduration_s = 3.0\namplitude_m = 0.05\napart_m = 0.1'
WALL = "{ kind = 'wall', point_m = [1.69, 0.0], normal = [-1.0, 0.0], stiffness_n_m = 1000.0 }"
TRACK = 'kind = "track"\nduration_s = 2.0\namplitude_m = 0.05'


def write_protocol(
    folder: Path, users: str = '["m1"]', task: str = REACH, more: str = "", first: float = 0.7
) -> Path:
    """Writes it; `more` follows its task, and `first` is the first user's share of the slave."""
    file = folder / "short.toml"
    text = (
        TEXT.format(users=users, task=task, design="fixed" if "m2" in users else "williams")
        + more
    )
    if "contact" in task:
        text = text.replace("sites.s = { ", f"sites.s = {{ environment = [{WALL}], ")
    text = text.replace("{ m1 = 0.7, m2 = 0.3 }", f"{{ m1 = {first}, m2 = {1.0 - first:.1f} }}")
    file.write_text(text, encoding="utf-8")
    return file


def write_hurried_pair(folder: Path) -> Path:
    """Writes the protocol of a pair whose time is short for the second condition, with questionnaires."""
    file = write_protocol(
        folder, '["m1", "m2"]', REACH.replace("timeout_s = 6.0", "timeout_s = 1.2")
    )
    forms = 'questionnaires = [{ name = "tlx" }, { name = "agency", after = "experiment" }]\n'
    file.write_text(
        file.read_text(encoding="utf-8").replace("[set]", f"{forms}[set]"), encoding="utf-8"
    )
    return file


def answer_form(
    experiment: Experiment, cell: str, number: int, who: str, form: str, values: list[Any]
) -> None:
    """Adds the answers of a participant to a questionnaire; None is a question without an answer."""
    items = [item for item in experiment.plan.protocol.questionnaires if item.name == form]
    answers = items[0].find_form().read(values)
    with experiment.open_notes() as notes:
        notes.add(Note(cell, "questionnaire", who, number, 0.0, form, answers))
