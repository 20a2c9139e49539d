"""The blocks of the documentation: each block runs and gives the output beside it, or has a
stated reason.
"""

import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Callable
from contextlib import redirect_stdout
from importlib import resources
from io import StringIO
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import polars as pl
import pytest
import tomli_w
from latex2mathml.converter import convert

import trilat_net as tn
from tests.cli.running import assert_parses, trilat
from tests.documentation import (
    ELSEWHERE,
    NOT_RUN,
    PAGES,
    ROOT,
    Block,
    find_blocks,
    find_exception,
    read_commands,
)
from tests.golden.surface import all_options
from tests.live.processes import BEGUN, Process
from tests.scenario.round_trips import write_irtt_file

BLOCKS = [block for page in PAGES for block in find_blocks(page)]
SCENARIOS = resources.files("trilat_net") / "scenarios"
OPTIONS = all_options()


def test_every_exception_names_an_existing_test() -> None:
    for name, why in {**ELSEWHERE, **NOT_RUN}.items():
        assert sum(block.name.startswith(name) for block in BLOCKS) >= 1, name
        assert (ROOT / why).is_file() or why in NOT_RUN.values(), why
    assert not ELSEWHERE.keys() & NOT_RUN.keys()


def test_every_block_runs_or_has_a_reason() -> None:
    runs = {"sh": COMMAND_PAGES, "python": PYTHON_PAGES, "toml": set(SCENARIO_OF)}
    blocks = [block for block in BLOCKS if block.language not in ("", "math")]
    assert len(blocks) > 60
    assert not [
        b.name for b in blocks if b.page not in runs[b.language] and not find_exception(b)
    ]


@pytest.mark.parametrize("page", PAGES)
def test_every_formula_becomes_mathml(page: str) -> None:
    text = (ROOT / page).read_text(encoding="utf-8")
    blocks = [block.text for block in find_blocks(page) if block.language == "math"]
    for formula in (*blocks, *re.findall(r"\$`([^`]+)`\$", text)):
        converted = convert(formula.strip())
        assert converted.startswith("<math")
        assert "\\" not in converted, formula  # a command that is not known
        # GitHub refuses these, see https://github.com/github/markup/issues/1688
        assert not re.search(r"\\(?:operatorname|mbox|phantom)\b", formula), formula


@pytest.mark.parametrize("page", PAGES)
def test_no_formula_breaks_its_table(page: str) -> None:
    """A bar would end the cell: GitHub and Zensical want the command for it, as in \\lvert x \\rvert."""
    rows = re.findall(r"^\|.*$", (ROOT / page).read_text(encoding="utf-8"), re.MULTILINE)
    assert not [row for row in rows if "|" in "".join(re.findall(r"\$`([^`]+)`\$", row))]


@pytest.mark.parametrize("page", PAGES)
def test_commands_parse_as_written(page: str) -> None:
    for block in find_blocks(page):
        for arguments, _ in read_commands(block.text) if block.language == "sh" else ():
            if arguments[0] == "trilat":
                assert_parses(arguments)


@pytest.mark.parametrize("page", PAGES)
def test_commands_in_sentences_have_their_options(page: str) -> None:
    for text in re.findall(r"`(trilat [^`]*)`", (ROOT / page).read_text(encoding="utf-8")):
        matches = re.findall(r"[^\s\[\]|,()]+", text)
        (name, *_) = [w for w in (" ".join(matches[:n]) for n in (3, 2, 1)) if w in OPTIONS]
        below = [names for known, names in OPTIONS.items() if known.startswith(name)]
        known = {option for option_names in below for option in option_names} | {
            "--help",
            "--version",
            "--install-completion",
        }
        options = {word.partition("=")[0] for word in matches if re.match(r"--?[a-z]", word)}
        assert not options - known, text


# --- settings ---------------------------------------------------------------------------------------------

SCENARIO_OF = {
    "docs/reference/experiment-protocol.md": "paper",
    "docs/reference/arm-keys.md": "six_joints",
    "docs/extend/arms.md": "six_joints",
    "docs/sessions/devices.md": "play",
    "docs/sessions/external-arm.md": "two_sites",
    "docs/reference/links.md": "paper",
    "docs/studies/measured-hands.md": "two_sites",
    "docs/reference/silent-peers.md": "paper",
    "docs/sessions/live-hands.md": "play",
    "docs/reference/operators.md": "paper",
    "docs/logs/felt-forces.md": "free",
    "docs/extend/own-controller.md": "paper",
    "docs/extend/own-plant.md": "paper",
    "docs/studies/policies.md": "paper",
    "docs/studies/seeds.md": "free",
}
"""By page the scenario into which its settings are put."""


def merge_tables(base: dict[str, Any], more: dict[str, Any]) -> dict[str, Any]:
    both = dict(base)
    for key, value in more.items():
        nested = isinstance(value, dict) and isinstance(both.get(key), dict)
        both[key] = merge_tables(both[key], value) if nested else value
    return both


@pytest.mark.parametrize(
    "block", [b for b in BLOCKS if b.language == "toml"], ids=lambda block: block.name
)
def test_settings_make_a_scenario(
    block: Block, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    text = block.text
    if block.page == "docs/logs/felt-forces.md":  # each line is one way to push
        for line in text.splitlines():
            hands = tomllib.loads(line)
            assert (
                tn.load_scenario("free", {"sites.m1.hands": hands["hands"]}).sites["m1"].hands
            )
        return
    if block.page == "docs/reference/experiment-protocol.md":
        written = tn.new_experiment("p.toml").read_text(encoding="utf-8")
        (tmp_path / "p.toml").write_text(
            written.replace("[set]", text + "[set]", 1), encoding="utf-8"
        )
        protocol = tn.check_experiment("p.toml").protocol
        assert len(protocol.questionnaires) == 3 or protocol.staircase
        return
    if text.startswith("name"):
        (tmp_path / "mine.toml").write_text(write_own_arm(tmp_path, text))
        assert tn.load_scenario(tmp_path / "mine.toml").names == ("m", "s")
        return
    if block.page == "docs/extend/own-controller.md":
        (tmp_path / "mylaws.py").write_text(find_blocks(block.page)[0].text)
    for code in (
        *find_blocks("docs/studies/policies.md"),
        *find_blocks("docs/extend/own-plant.md"),
    ):
        if named := re.match(r"# (my_\w+\.py)\n", code.text):
            (tmp_path / named[1]).write_text(code.text)
    base = tomllib.loads(
        (SCENARIOS / f"{SCENARIO_OF[block.page]}.toml").read_text(encoding="utf-8")
    )
    stated = tomllib.loads(text)
    (tmp_path / "arm6.urdf").write_text((SCENARIOS / "arm6.urdf").read_text(encoding="utf-8"))
    (tmp_path / "whole.toml").write_text(tomli_w.dumps(merge_tables(base, stated)))
    scenario = tn.load_scenario(tmp_path / "whole.toml")
    for key in ("arm", "on_stale"):
        if key in stated:
            assert all(getattr(site, key) is not None for site in scenario.sites.values())


def write_own_arm(folder: Path, text: str) -> str:
    """Replaces a robot's file that is not shipped by an arm of the package; returns the scenario."""
    shutil.copy(str(SCENARIOS / "arm6.urdf"), folder / "ur5_robot.urdf")
    return text.replace('"tool0"', '"flange"')


# --- commands ---------------------------------------------------------------------------------------------

PUSHED_COMMAND_PAGES = {"docs/extend/delay-traces.md"}
PUSHED_PYTHON_PAGES = {
    "docs/reference/observed-energy.md",
    "docs/extend/own-plant.md",
    "docs/studies/policies.md",
    "docs/studies/train-policies.md",
}
"""Pages whose blocks run on every push; those of the others run in `make test-long`."""


def list_pages(pages: set[str], pushed: set[str]) -> list[Any]:
    """Returns pages as parameters of a test; all but those that run on every push are long."""
    assert pushed <= pages
    slow = pytest.mark.long
    return [
        pytest.param(page, marks=() if page in pushed else slow, id=page)
        for page in sorted(pages)
    ]


COMMAND_PAGES = {
    "docs/extend/arm-gains.md",
    "docs/extend/arms.md",
    "docs/reference/certificate-premises.md",
    "docs/theory/certificate-energy.md",
    "docs/theory/coming-to-rest.md",
    "docs/theory/damping-conditions.md",
    "docs/extend/delay-traces.md",
    "docs/studies/fair-comparison.md",
    "docs/tutorials/first-hour.md",
    "docs/tutorials/first-result.md",
    "docs/tutorials/lab.md",
    "docs/reference/laws.md",
    "docs/reference/links.md",
    "docs/studies/linear.md",
    "docs/overview.md",
    "docs/studies/policies.md",
    "docs/reference/metrics.md",
    "docs/reference/silent-peers.md",
    "docs/reference/stability.md",
    "docs/studies/ports.md",
    "docs/logs/log-checks.md",
    "docs/logs/log-tools.md",
    "docs/logs/rerun.md",
    "docs/logs/verify.md",
    "docs/studies/seeds.md",
}
SHORTER = ["--law", "p_d,adaptive", "--budget", "4", "--duration", "2", "--jobs", "1"]
"""What is added to a command that tunes, which else would take minutes."""
OF_RUNS = {
    "docs/reference/certificate-premises.md": "paper",
    "docs/theory/certificate-energy.md": "paper",
    "docs/reference/stability.md": "paper",
    "docs/reference/metrics.md": "paper",
    "docs/reference/json.md": "free",
    "docs/reference/log.md": "free",
    "docs/logs/log-checks.md": "paper",
    "docs/logs/log-tools.md": "paper",
    "docs/logs/rerun.md": "paper",
    "docs/logs/verify.md": "paper",
}
"""Pages whose blocks are about run.mcap, and its scenario."""


def write_assumed_files(page: str, folder: Path) -> None:
    """Makes the files that a page assumes."""
    if page in OF_RUNS:
        trilat("sim", OF_RUNS[page], "-o", "run.mcap", cwd=folder).succeeds()
    if page == "docs/tutorials/first-hour.md":  # the log of the reader's session
        session = folder / "runs" / "play-001"
        session.mkdir(parents=True)
        trilat("sim", "play", "--duration", "3", "-o", "run.mcap", cwd=session).succeeds()
    if page == "docs/studies/policies.md":
        (code, *_) = find_blocks(page)
        (folder / "my_policy.py").write_text(code.text)
    if page == "docs/extend/delay-traces.md":
        write_irtt_file(folder, zipped=True)
    if page == "docs/extend/arms.md":
        (name_block,) = (block for block in find_blocks(page) if block.text.startswith("name"))
        (folder / "mine.toml").write_text(write_own_arm(folder, name_block.text))


@pytest.mark.parametrize(
    "page", list_pages(COMMAND_PAGES - {"docs/tutorials/lab.md"}, PUSHED_COMMAND_PAGES)
)
def test_page_commands_print_their_shown_output(page: str, tmp_path: Path) -> None:
    write_assumed_files(page, tmp_path)
    for block in find_blocks(page):
        if block.language != "sh" or find_exception(block):
            continue
        for arguments, output in read_commands(block.text):
            shorter = SHORTER if "--tune" in arguments else []
            done = trilat(*arguments[1:], *shorter, cwd=tmp_path)
            assert done.code in (0, 1), (arguments, done)
            printed = " ".join((done.out + done.err).split())
            for line in output:
                assert line in printed, (arguments, line, done)


@pytest.mark.long
@pytest.mark.live
def test_documented_hands_take_and_release_arms(tmp_path: Path) -> None:
    arguments = ("--scenario", "play", "--set", "duration_s=600")
    sites = [
        Process(name, ["site", name, *arguments], tmp_path)
        for name in tn.load_scenario("play").names
    ]
    try:
        sites[0].prints(BEGUN)
        names: dict[str, Any] = {"__name__": "page"}
        run_page_python("docs/sessions/live-hands.md", tmp_path, names)
        assert len(names["hand"].pose) == 2
    finally:
        for site in sites:
            site.end()


# --- Python -----------------------------------------------------------------------------------------------

PYTHON_PAGES = {
    "docs/tutorials/first-hour.md",
    "docs/extend/law-interface.md",
    "docs/reference/json.md",
    "docs/tutorials/lab-answers.md",
    "docs/theory/linear-examples.md",
    "docs/studies/linear.md",
    "docs/sessions/live-hands.md",
    "docs/reference/log.md",
    "docs/logs/log-tools.md",
    "docs/reference/observed-energy.md",
    "docs/extend/own-controller.md",
    "docs/extend/own-plant.md",
    "docs/studies/policies.md",
    "docs/theory/port-results.md",
    "docs/studies/python.md",
    "docs/logs/rerun.md",
    "docs/studies/train-policies.md",
    "docs/reference/sweep-results.md",
}
OF_THEIR_OWN = {"docs/sessions/live-hands.md", "docs/reference/sweep-results.md"}
"""Pages whose code needs a session or a sweep, which a test of their own makes."""
AT_HAND = {
    "docs/reference/observed-energy.md": "import numpy as np\nfrom trilat_net.core.plug.law_energy import *\n",
    "docs/logs/rerun.md": "import trilat_net\n",
}
"""What a page takes for granted in its code."""


def run_page_python(page: str, folder: Path, names: dict[str, Any] | None = None) -> str:
    """Runs the code of a page in a folder, in one namespace; returns its output."""
    space: dict[str, Any] = {"__name__": "page"} if names is None else names
    stream = StringIO()
    with redirect_stdout(stream), pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for code in (
            AT_HAND.get(page, ""),
            *(
                b.text
                for b in find_blocks(page)
                if b.language == "python" and find_exception(b) not in NOT_RUN.values()
            ),
        ):
            exec(compile(code, page, "exec"), space)
    return stream.getvalue()


def check_linear(printed: str, _: dict[str, Any]) -> None:
    assert printed.startswith("LinearEdge(key='control.Kd', value=1.31")


def check_linear_examples(printed: str, _: dict[str, Any]) -> None:
    page = (ROOT / "docs/theory/linear-examples.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| roots \| (.+) \|$", page, re.MULTILINE)
    table = [cell for row in rows for cell in row.split(" | ")]
    assert [line.split()[3] for line in printed.splitlines()] == table


def check_ports(_: str, names: dict[str, Any]) -> None:
    """Compares the lines of the command on docs/studies/ports.md with those of this page's function."""
    (block,) = (
        code_block
        for code_block in find_blocks("docs/studies/ports.md")
        if code_block.language == "sh"
    )
    ((_, output),) = read_commands(block.text)
    results = names["describe_ports"](names["ports"]("p_d_margin_two", control__d=1.96))
    assert output == [" ".join(line.split()) for line in results[:2]]


def check_energies(_: str, names: dict[str, Any]) -> None:
    """Asserts that a line that carries 2 N m for a second took, and gave, 2 J."""
    u = {"u": np.full((1000, 1), 2.0)}
    peers = [SimpleNamespace(sent=u, received=u)]
    energies = names["energies"](None, SimpleNamespace(h_s=1e-3, peers=peers))
    assert energies.gave[0][-1] == pytest.approx(2.0)
    assert energies.took[0][-1] == pytest.approx(2.0)


def check_rerun(_: str, names: dict[str, Any]) -> None:
    error = names["again"].sites["s"].error_rms_rad
    page = (ROOT / "docs/logs/rerun.md").read_text(encoding="utf-8")
    assert f"(before={error.before:.4f}, after={error.after:.4f})" in page


def check_groups(output: str, _: dict[str, Any]) -> None:
    """Every group of the lab has gains of its own, and abs(lambda_min) K T as its margins."""
    rows = [[float(word) for word in line.split()] for line in output.splitlines()[1:]]
    assert len({tuple(row[1:4]) for row in rows}) == len(rows) == 15
    for _, stiffness, delay_ms, share, *_, three, two, unequal in rows:
        at_one = stiffness * delay_ms / 1000.0
        wanted = (0.5 * at_one, at_one, share * at_one)
        assert (three, two, unequal) == pytest.approx(wanted, abs=1e-3)


CHECKS: dict[str, Callable[[str, dict[str, Any]], None]] = {
    "docs/studies/linear.md": check_linear,
    "docs/theory/port-results.md": check_ports,
    "docs/theory/linear-examples.md": check_linear_examples,
    "docs/reference/observed-energy.md": check_energies,
    "docs/logs/rerun.md": check_rerun,
    "docs/tutorials/lab-answers.md": check_groups,
}
"""By page what it says of the results of its code."""


@pytest.mark.parametrize("page", list_pages(PYTHON_PAGES - OF_THEIR_OWN, PUSHED_PYTHON_PAGES))
def test_page_code_finds_its_stated_results(page: str, tmp_path: Path) -> None:
    write_assumed_files(page, tmp_path)
    names: dict[str, Any] = {"__name__": "page"}
    output = run_page_python(page, tmp_path, names)
    if page in CHECKS:
        CHECKS[page](output, names)
    else:
        assert output.splitlines() == list_shown(page)


def list_shown(page: str) -> list[str]:
    """Returns the output that a page shows: the block right after the code."""
    blocks = find_blocks(page)
    text = (ROOT / page).read_text(encoding="utf-8")
    output_lines: list[str] = []
    for code, after in pairwise(blocks):
        between = text.partition(code.text)[2].partition(after.text)[0]
        if (
            code.language == "python"
            and after.language == ""
            and between.split() == ["```", "```text"]
        ):
            output_lines += after.text.splitlines()
    return output_lines


@pytest.mark.long
def test_simulated_episodes_become_a_table(tmp_path: Path) -> None:
    """The commands of the section run as written, in an empty folder."""
    (block,) = (
        block
        for block in find_blocks("docs/studies/lerobot.md")
        if block.text.startswith("$ mkdir episodes")
    )
    script = re.sub(r"^\$ ", "", block.text, flags=re.MULTILINE)
    program = shlex.quote(sys.executable)
    functions = f'trilat() {{ {program} -m trilat_net "$@"; }}; python() {{ {program} "$@"; }}'
    done = subprocess.run(
        ["bash", "-ec", f"{functions}\n{script}"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "'age_s.m1'" in done.stdout
    frames = pl.read_parquet(tmp_path / "simulated" / "data" / "chunk-000" / "file-000.parquet")
    largest = frames.group_by("episode_index", maintain_order=True).agg(pl.max("age_s.m1"))
    assert largest["age_s.m1"].to_list() == pytest.approx([0.1, 0.2, 0.3, 0.4], abs=2e-3)


@pytest.mark.long
def test_code_about_sweeps_reads_their_results(tmp_path: Path) -> None:
    over = [
        "--over",
        "link.delay_ms=0,100",
        "--over",
        "control.d=0.2,3",
        "--duration",
        "2",
        "--jobs",
        "1",
    ]
    trilat("sweep", "p_d_margin", *over, cwd=tmp_path).succeeds()
    names: dict[str, Any] = {"__name__": "page"}
    run_page_python("docs/reference/sweep-results.md", tmp_path, names)
    assert len(names["results"].rows) == names["plan"].cells == 135
    assert names["least"].keys() <= {0.0, 100.0}


@pytest.mark.long
def test_certificates_begin_as_shown_on_their_page(tmp_path: Path) -> None:
    trilat("sim", "paper", "-o", "run.mcap", cwd=tmp_path).succeeds()
    (output,) = (
        b.text
        for b in find_blocks("docs/logs/certificate.md")
        if b.text.startswith("ok   stable")
    )
    assert trilat("certify", "run.mcap", cwd=tmp_path).out.startswith(output.rstrip())
