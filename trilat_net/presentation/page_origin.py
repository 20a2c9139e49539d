"""Renders the section of a report that says how the run was executed and how to repeat it.

The section contains the description of the scenario, facts about the recording, the commands
that check and repeat the run, the assumptions, and the software versions.

Invariant:
    - All parts of this section except the commands are collapsed.
"""

import shlex
from datetime import UTC, datetime
from pathlib import Path

from markupsafe import Markup

from ..errors import count_nouns, join_words
from ..log import Log, describe_unknown_ends
from ..results import JsonObject
from ..scenario import Scenario, ScenarioDifference, list_shipped, load_scenario
from .html_templates import render_macro
from .page_html import render_details, render_facts, render_folds, render_section
from .page_timeline import describe_dominance

_STATED_KEYS = ("seed", "duration_s")
"""Settings that are already shown next to the title."""
_MAX_CHANGES = 3
"""Maximum number of changed settings at the top of the page."""


def render_origin(log: Log, facts: JsonObject, licence: str) -> Markup:
    """Renders the section of a report that lets a reader repeat the run.

    The section contains the commands, the scenario, the assumptions and the software versions.

    Args:
        log: Log of the run.
        facts: Key figures of the run, from `summarise_run`.
        licence: Licence of the plotting library embedded in the page.
    """
    scenario = log.scenario
    name, hint = _find_scenario_argument(scenario)
    recording = _list_recording_facts(log, facts)

    folds = [
        render_details("What this scenario is about", _render_description(scenario)),
        render_details("What is assumed", _render_assumptions(scenario)),
        render_details(f"The resolved scenario, {hint}", _render_code(scenario.text)),
        render_details("The recording", render_facts(recording)),
        render_details("Versions of the software", render_facts(_list_versions(log))),
        render_details("Licence of the plotting library", _render_code(licence)),
    ]

    body = _render_code(_list_commands(log, name)) + render_folds(folds)
    intro = "These commands check the log, simulate its run again, and run its scenario."

    law_files = _list_law_files(scenario)
    if law_files:
        intro += (
            f" They execute {join_words(law_files)}, which another person may have written. "
            "Run them in the folder from which the code is imported, with the log beside it."
        )
    return render_section("Do this again", intro, body, "origin")


def summarise_origin(log: Log) -> str:
    """Returns the name, length and origin of a run on one line, for the top of the page.

    The origin is, for example, a live session or a simulation in virtual time.

    Args:
        log: Log of the run.
    """
    scenario = log.scenario
    driver = _describe_driver(log)
    length = f"{scenario.duration_s:g} s"
    return f"{scenario.name} · {length} · {driver} · seed {scenario.seed}"


def describe_changes(scenario: Scenario) -> str:
    """Returns how a scenario differs from the example scenario with the same name and title.

    The title and description of a scenario refer to its original settings, but a run with other
    settings, for example from `trilat rerun`, has the same title and description. The reader
    must therefore be told about the differences.

    Args:
        scenario: Scenario of the run.

    Returns:
        A phrase such as "every link: constant 800 ms instead of constant 400 ms". Empty if
        there are no such differences, or if no example scenario in the package has this name
        and title.
    """
    if scenario.name not in list_shipped():
        return ""

    shipped = load_scenario(scenario.name)
    if shipped.title != scenario.title:
        return ""

    all_differences = ScenarioDifference.list_between([shipped, scenario])
    differences = [entry for entry in all_differences if entry.key not in _STATED_KEYS]
    phrases = []
    for difference in differences[:_MAX_CHANGES]:
        shipped_value, value = difference.values
        phrases.append(f"{difference}: {value} instead of {shipped_value}")

    if len(differences) > _MAX_CHANGES:
        phrases.append(f"and {count_nouns(len(differences) - _MAX_CHANGES, 'more setting')}")
    return "; ".join(phrases)


def _render_description(scenario: Scenario) -> Markup:
    """Renders a scenario's description as paragraphs, with text in backticks as code."""
    paragraphs = [text for text in scenario.about.strip().split("\n\n") if text]
    return render_macro("origin.html", "description", paragraphs=paragraphs)


def _render_assumptions(scenario: Scenario) -> Markup:
    """Renders the list of assumptions declared by the scenario, and the notes on its arms."""
    texts = [*scenario.assumed, *scenario.list_arm_notes()]
    return render_macro("origin.html", "assumptions", texts=texts)


def _list_recording_facts(log: Log, facts: JsonObject) -> list[tuple[str, str]]:
    """Returns facts about a recording, such as its length and missing records, for a table.

    Each fact is a pair of heading and text.
    """
    scenario = log.scenario
    records = f"{facts['records']}, {facts['missing']} missing"
    if not log.complete:
        records += "; the file was not finished"
    if log.unknown_ends:
        records += f"; {describe_unknown_ends(log.unknown_ends)}"
    return [
        ("scenario", f"{scenario.name}, sha256 {scenario.sha256[:16]}"),
        ("driven by", _describe_driver(log)),
        ("length", f"{scenario.duration_s:g} s; scheme {scenario.scheme}"),
        ("records", records),
        ("dominance", describe_dominance(scenario)),
        ("diverged", "yes" if facts["diverged"] else "no"),
    ]


def _describe_driver(log: Log) -> str:
    """Returns a text on how a run was executed: simulated, repeated from a log, or live.

    For a live session, the text includes its start time ("epoch").
    """
    session = log.session
    if log.driver == "virtual":
        return "simulated in virtual time"

    if log.driver == "rerun":
        source = session.get("rerun_of", "") or "a log"
        sites = session.get("rerun_executed", "").replace(" ", ", ")
        return f"rerun of {source}: {sites} executed afresh"

    epoch_s = int(session.get("epoch_unix_ns", "0")) // 10**9
    epoch = datetime.fromtimestamp(epoch_s, UTC)
    return f"live, session {session.get('session', '')}, epoch {epoch:%Y-%m-%d %H:%M:%S} UTC"


def _find_scenario_argument(scenario: Scenario) -> tuple[str, str]:
    """Returns how a command refers to the scenario, and where the scenario comes from.

    The name is enough for a scenario shipped with this program. For any other, a command first
    saves the text of the scenario to a file.
    """
    has_shipped_name = scenario.name in list_shipped()
    if has_shipped_name and load_scenario(scenario.name).sha256 == scenario.sha256:
        return scenario.name, "as shipped"
    return f"./{scenario.name}.toml", "as the log contains it"


def _list_commands(log: Log, scenario: str) -> str:
    """Returns the shell commands that check and repeat the run.

    Args:
        log: Log of the run.
        scenario: Name or path of the scenario.
    """
    file_name = Path(log.source).name
    if not file_name.endswith(".mcap"):
        file_name = "FILE"  # the log was not read from a file

    # Commands execute a user's Python code only if the user permits each file.
    permissions = [f" --law {shlex.quote(file)}" for file in _list_law_files(log.scenario)]
    log_argument = file_name + "".join(permissions)

    commands = [f"trilat verify {log_argument}", f"trilat verify --virtual {log_argument}"]
    if scenario.endswith(".toml"):  # the scenario is not shipped, and must be written first
        commands.append(f"trilat scenario show {file_name} > {scenario}")
    commands.append(f"trilat sim {scenario}")
    return "\n".join(commands)


def _list_law_files(scenario: Scenario) -> list[str]:
    """Returns the files of the user-written control laws, relative to the import folder.

    A log contains the module name of a law, such as "mine.laws", but not the folder of its
    file.
    """
    files = []
    for law in scenario.inspect_user_laws():
        module, _, _ = law.code.partition(":")
        files.append(f"{module.replace('.', '/')}.py")
    return list(dict.fromkeys(files))


def _list_versions(log: Log) -> list[tuple[str, str]]:
    """Returns the software and the machine that recorded a log, as pairs of name and text.

    The arithmetic fingerprint shows whether another machine computes bit-identical results.
    """
    session = log.session
    commit = session.get("commit", "unknown")
    if session.get("commit_dirty") == "true":
        commit += " with changes"
    platform = session.get("platform", "unknown")
    python = session.get("python", "unknown")
    entries = [
        ("commit", commit),
        ("fingerprint of arithmetic", session.get("fingerprint", "unknown")),
        ("platform", f"{platform}, {python}"),
    ]

    prefix = "version_"
    for key, version in session.items():
        if key.startswith(prefix):
            entries.append((key.removeprefix(prefix), version))
    return entries


def _render_code(text: str) -> Markup:
    """Renders commands or the contents of a file as HTML in a monospaced font.

    Line breaks are preserved.

    Args:
        text: The commands or the contents, as plain text.
    """
    return render_macro("parts.html", "code", text=text)
