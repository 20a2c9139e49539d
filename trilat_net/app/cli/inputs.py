"""Commands for the inputs of a run: scenarios, user-written code, measured delays, and keys.

A scenario is a TOML file that describes an experiment. Users can write their own control laws,
operators (programs that move an arm) and plants (models of an arm). Delays measured on a real
network can be replayed in a simulation. With keys, each process of a session proves its
identity to the others.
"""

import shlex
import sys
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from ...errors import ScenarioError, UsageError, count_nouns
from ...files import refuse_existing, write_whole
from ...presentation import TextTable
from ...presentation import terminal_output as terminal
from . import options
from .options import flag, value


@options.command("")
def scenario_list_command(as_json: options.JsonOption = False) -> None:
    """Lists the shipped scenarios."""
    from ...scenario import list_shipped, load_scenario

    scenarios = {name: load_scenario(name) for name in list_shipped()}
    if as_json:
        entries = []
        for name, scenario in scenarios.items():
            entry = {
                "name": name,
                "sites": scenario.names,
                "duration_s": scenario.duration_s,
                "title": scenario.title,
            }
            entries.append(entry)
        return terminal.print_json(entries)

    rows = []
    for name, scenario in scenarios.items():
        site_count = str(len(scenario.names))
        rows.append((name, site_count, f"{scenario.duration_s:g} s", scenario.title))
    columns = ("name", "sites", "time", "what it is")
    return terminal.print_table(TextTable(columns, rows, align="lrrl"))


ShownScenario = Annotated[
    str,
    typer.Argument(
        help="Name of a shipped scenario, path of a TOML file, or a log (.mcap) that contains "
        "one.",
        autocompletion=options.complete_scenarios,
    ),
]
"""The scenario or the log whose scenario is printed."""


@options.command("paper --set control.Kd=5", page="docs/reference/laws.md")
def scenario_show_command(
    name: ShownScenario,
    duration: options.DurationOption = None,
    seed: options.SeedOption = None,
    overrides: options.SetOption = None,
) -> None:
    """Prints a scenario in full, including every value of every site and link."""
    if name.endswith(".mcap"):
        from ...log import open_log

        if overrides or duration is not None or seed is not None:
            raise ScenarioError(
                f"{name}: the scenario of a log cannot be changed; save it with `trilat "
                f"scenario show {name} > mine.toml`, and change the file"
            )
        scenario = open_log(Path(name)).scenario
    else:
        scenario = options.load_chosen_scenario(name, overrides, duration, seed)
    sys.stdout.write(scenario.text)
    for note in scenario.list_arm_notes():
        terminal.print_note(note)


@options.command("mine.toml", page="docs/extend/arms.md")
def scenario_check_command(
    file: options.ScenarioArgument,
    overrides: options.SetOption = None,
    as_json: options.JsonOption = False,
) -> None:
    """Checks a scenario and prints what its values imply."""
    from ...scenario import describe_scenario

    scenario = options.load_chosen_scenario(file, overrides, None, None)
    scenario.check_outside_arms()
    lines = describe_scenario(scenario)
    if as_json:
        facts = {"name": scenario.name, "sha256": scenario.sha256, "consequences": lines}
        return terminal.print_json(facts)

    terminal.print_texts(lines)
    return None


@options.command("mine.toml", page="docs/reference/links.md")
def scenario_new_command(
    file: Annotated[Path, typer.Argument(help="File to write.")],
    force: options.ForceOption = False,
) -> None:
    """Writes a scenario template with comments and the unit of every key."""
    from ...scenario import read_template

    write_whole(file, read_template(), force=force)
    terminal.print_text(f"{file} is a template; check it with: trilat scenario check {file}")


def _print_skeleton(kind: str, written: list[Path], key: str, checks: Sequence[str]) -> None:
    """Prints which files were written for a new law, hand or plant, and how to run them.

    A skeleton is a working example that a user changes: a control law, a program that acts as
    an operator (hand), or a model of an arm (plant).

    Args:
        kind: "law", "hand" or "plant".
        written: Path of the file, and path of its test.
        key: Override that makes a scenario use the class, with {} in place of the class.
        checks: The commands that examine the log of the run, as in "certify {log}", with {log}
            and {file} in place of the names of the log and of the file.
    """
    from ...scenario import name_skeleton_class

    file, test_file = written
    class_path = f"{file.stem}:{name_skeleton_class(file.stem, kind)}"
    change_folder = "" if file.parent == Path() else f"cd {file.parent}, and "
    terminal.print_text(
        f"{file} contains a working {kind}, and {test_file.name} its test. "
        f"Change the {kind}, {change_folder}run"
    )

    log_name = f"{file.stem}.mcap"
    terminal.print_text(f"  trilat sim paper --set {key.format(class_path)} -o {log_name}")
    for command in checks:
        command_line = command.format(log=log_name, file=file.name)
        terminal.print_text(f"  trilat {command_line}")
    terminal.print_text(f"  python -m pytest {test_file.name}   (python -m pip install pytest)")


@options.command("mylaw.py", page="docs/extend/own-controller.md")
def new_law_command(
    file: Annotated[Path, typer.Argument(help="File to write, for example mylaw.py.")],
    force: options.ForceOption = False,
) -> None:
    """Creates a working, commented control law to start from, and its test."""
    from ...scenario import new_law

    # A run with a user's law is at best judged settled, which gives exit code 1 without
    # --accept.
    checks = ("certify {log} --law {file} --accept settled", "report {log} --law {file}")
    _print_skeleton("law", new_law(file, force=force), "control.law={}", checks)


@options.command("myhand.py", page="docs/studies/policies.md")
def new_hand_command(
    file: Annotated[Path, typer.Argument(help="File to write, for example myhand.py.")],
    force: options.ForceOption = False,
) -> None:
    """Creates a working hand (a program that acts as a user) to start from, and its test."""
    from ...scenario import new_hand

    key = """'sites.m2.hands=[{{kind="own", class="{}"}}]'"""
    _print_skeleton("hand", new_hand(file, force=force), key, ["report {log}"])


@options.command("myplant.py", page="docs/extend/own-plant.md")
def new_plant_command(
    file: Annotated[Path, typer.Argument(help="File to write, for example myplant.py.")],
    force: options.ForceOption = False,
) -> None:
    """Creates a working plant (a model of an arm) to start from, and its test."""
    from ...scenario import new_plant

    _print_skeleton("plant", new_plant(file, force=force), "sites.s.plant={}", ["verify {log}"])


@options.command(
    "irtt run.json.gz",
    "csv drive.txt --way half -o drive.csv",
    page="docs/extend/delay-traces.md",
)
def trace_import_command(
    form: Annotated[
        str, typer.Argument(help="Format of FILE: irtt, ping or csv.", metavar="FORM")
    ],
    file: Annotated[Path, typer.Argument(metavar="FILE")],
    out: Annotated[Path | None, value("--out -o", "CSV")] = None,
    way: Annotated[str, value("--way", "half|send|receive|whole")] = "",
    column: Annotated[str, value("--column", "NAME")] = "",
    every_s: Annotated[
        float,
        value(
            "--every", "S", "Interval between pings, in s, if the output of ping has no times."
        ),
    ] = 1.0,
    as_json: options.JsonOption = False,
    force: options.ForceOption = False,
) -> None:
    """Converts delays measured by another program into a delay trace for links.

    The command also prints statistics of the network.

    Options:
        file: JSON output of irtt, text output of ping or fping, or a table with a header.
        out: Output file for the trace; default: the name of FILE with -trace.csv in place of
            its suffix, in the current folder.
        way: Delay to use: half of the round trip (half), one direction as measured by irtt
            (send or receive), or the delay unchanged (whole). Default: half of a round trip;
            one-way delays stay unchanged.
        column: Table column that contains the delays; default: the first one with a name such
            as delay, rtt or latency.
    """
    from ...scenario import import_trace

    stem = file.name.split(".")[0]
    path = out if out is not None else Path(f"{stem}-trace.csv")
    refuse_existing(path, force=force)
    trace = import_trace(file, form, way=way, column=column, every_s=every_s)
    write_whole(path, trace.write_rows())
    if as_json:
        terminal.print_json({**trace.to_dict(), "file": str(path)})
        return

    terminal.print_line(trace.summary())
    terminal.print_line(f"{path}: use it with --set link.model=trace --set link.file={path}")


@options.command(
    "keys m1 m2 s recorder operator --host 192.0.2.1", page="docs/sessions/keys.md"
)
def keys_new_command(
    folder: Annotated[
        Path, typer.Argument(help="Folder to create for the keys.", metavar="DIR")
    ],
    members: Annotated[list[str], typer.Argument(metavar="MEMBER...")],
    hosts: Annotated[list[str] | None, value("--host", "NAME")] = None,
    days: Annotated[
        int,
        typer.Option("--days", min=1, max=3650, help="Validity of the certificates, in days."),
    ] = 30,
) -> None:
    """Creates keys: a certificate authority, and a folder of keys for each member.

    Copy each folder to its member's machine over a channel that you trust, and pass the folder
    to commands with --keys. Members without keys, or with keys from another authority, cannot
    connect, and each member can send only under its own name. Keep the folder `authority` on a
    machine that runs no member. `trilat keys renew` needs this folder before the keys expire,
    and so does `trilat keys add` to add members.

    Options:
        members: Members of the session: all sites, and the recorder, operator, router and
            bridge if the session has them.
        hosts: Host name or address on which a member listens; repeatable. This machine is
            always included.
    """
    from ...net import create_keys

    folders = create_keys(folder, members, hosts or (), days)
    for member_folder in folders:
        terminal.print_line(f"{member_folder}: keys for {member_folder.name}")
    first = folders[0]
    terminal.print_line(
        f"they are valid for {count_nouns(days, 'day')}; use them as in: "
        f"trilat site {first.name} --keys {first} ..."
    )


@options.command("keys s2 bridge --host 192.0.2.9", page="docs/sessions/keys.md")
def keys_add_command(
    folder: Annotated[
        Path, typer.Argument(help="Folder that `trilat keys new` created.", metavar="DIR")
    ],
    members: Annotated[
        list[str], typer.Argument(help="Names of the new members.", metavar="MEMBER...")
    ],
    hosts: Annotated[
        list[str] | None,
        value(
            "--host",
            "NAME",
            "Host name or address on which a new member listens; repeatable. This machine is "
            "always included.",
        ),
    ] = None,
    days: Annotated[
        int,
        typer.Option(
            "--days", min=1, max=3650, help="Validity of the new certificates, in days."
        ),
    ] = 30,
) -> None:
    """Creates keys for additional members; existing keys stay valid.

    The authority in the folder signs the new certificates. Copy each new folder to its member's
    machine. Also copy the updated file members.json, which lists all members, to every other
    member, and restart that member before the next session: until then it rejects messages from
    the new members.
    """
    from ...net import MEMBERS, add_keys

    new_folders = add_keys(folder, members, hosts or (), days)
    for member_folder in new_folders:
        terminal.print_line(f"{member_folder}: keys for {member_folder.name}; copy the folder")
    # The other members need the new list of all members.
    for path in sorted(folder.glob(f"*/{MEMBERS}")):
        if path.parent not in new_folders:
            terminal.print_line(
                f"{path}: list of members for {path.parent.name}; copy this file"
            )
    terminal.print_line(f"the new keys are valid for {count_nouns(days, 'day')}")


@options.command("keys", "keys m1 recorder --days 90", page="docs/sessions/keys.md")
def keys_renew_command(
    folder: Annotated[
        Path, typer.Argument(help="Folder that `trilat keys new` created.", metavar="DIR")
    ],
    members: Annotated[list[str] | None, typer.Argument(metavar="[MEMBER]...")] = None,
    days: Annotated[
        int,
        typer.Option("--days", min=1, max=3650, help="Validity of the certificates, in days."),
    ] = 30,
) -> None:
    """Renews the certificates of members; their private keys stay the same.

    The authority in the folder signs the new certificates. Copy the files authority.pem,
    certificate.pem and members.json from each folder to its member's machine again, and restart
    the member before its next session, because a running member keeps using its old
    certificate.

    Options:
        members: Members whose certificates are renewed; default: all members that have a
            folder.
    """
    from ...net import renew_keys

    for member_folder in renew_keys(folder, members or (), days):
        terminal.print_line(
            f"{member_folder}: keys are valid for {count_nouns(days, 'day')} from now"
        )


@options.command("lab", page="docs/logs/log-checks.md")
def keys_pair_command(
    name: Annotated[
        Path,
        typer.Argument(
            help="Name of the pair; its files are NAME.key and NAME.pub.", metavar="NAME"
        ),
    ],
) -> None:
    """Creates an Ed25519 key pair for signing logs and verifying signatures.

    Keep NAME.key private. Give NAME.pub to everyone who checks your logs, over a channel that
    they trust.
    """
    from ...log import create_signing_keys

    private, public = create_signing_keys(name)
    terminal.print_text(
        f"{private} signs logs, as in: trilat log sign run.mcap --key {private}"
    )
    terminal.print_text(
        f"{public} checks signatures, as in: trilat log check run.mcap --key {public}"
    )


@options.command("keys/m1", page="docs/sessions/keys.md")
def keys_info_command(
    folder: Annotated[Path, typer.Argument(help="Folder of one member's keys.", metavar="DIR")],
    rules: Annotated[bool, flag("--rules", "Print the Zenoh settings with all rules.")] = False,
    as_json: options.JsonOption = False,
) -> None:
    """Shows whose keys these are, when and where they are valid, and what they permit."""
    from ...net import ROLES, ROUTER, read_member_keys

    if rules and as_json:
        raise UsageError("--rules and --json cannot be combined: --json contains the rules")

    keys = read_member_keys(folder)
    if as_json:
        description = {
            "member": keys.member,
            "members": list(keys.members),
            "until": keys.ends.isoformat(),
            "hosts": list(keys.hosts),
            "zenoh": keys.settings,
        }
        return terminal.print_json(description)

    if rules:
        return terminal.print_json(keys.settings)

    kind_prefix = "" if keys.member in {*ROLES, ROUTER} else "site "
    other_members = [member for member in keys.members if member != keys.member]
    others_text = ", ".join(other_members)
    days_left = (keys.ends - datetime.now(UTC)).days
    days_text = count_nouns(days_left, "day")
    terminal.print_texts(
        [
            f"{folder}: keys of {kind_prefix}{keys.member}, for a session with {others_text}",
            f"valid until {keys.ends:%Y-%m-%d %H:%M} UTC, {days_text} from now",
            f"others may reach it at: {', '.join(keys.hosts)}",
            *_describe_role(keys.member),
            f"all rules: trilat keys info {shlex.quote(str(folder))} --rules",
        ]
    )
    return None


def _describe_role(member: str) -> list[str]:
    """Describes what a member with keys may send, with one line per kind of receiver.

    Replies, queries for information and liveliness tokens are left out, because every member
    may send them.

    Args:
        member: Name of the member, which determines its role.
    """
    from ...net import ROLES, ROUTER, SITE_ROLE, topics

    if member == ROUTER:
        return ["forwards the messages of all members, whatever they contain"]
    channel_words = {
        topics.SAMPLE: "samples",
        topics.STATE: "records",
        topics.LINK: "statistics of its loop and links",
        topics.EVENT: "events",
        topics.MEASURED: "measurements of an external arm",
        topics.VIEW: "views for an operator's program",
        topics.STATS: "statistics of the recording",
        topics.HAND: "live hands",
        topics.ENABLE: "reports of a dead-man switch",
        topics.SET: "all orders, such as set, enable and reset",
        topics.STOP: "the order to stop",
    }
    permissions = ROLES.get(member, SITE_ROLE)
    request_channels = [
        channel for channel in permissions.queries if channel in (topics.SET, topics.STOP)
    ]
    to_others = [
        channel_words[channel] for channel in (*permissions.publishes_to, *request_channels)
    ]
    descriptions = []
    if permissions.publishes:
        published = [channel_words[channel] for channel in permissions.publishes]
        descriptions.append(f"may send in its own name: {', '.join(published)}")
    if to_others:
        descriptions.append(f"may send to every site: {', '.join(to_others)}")
    return descriptions
