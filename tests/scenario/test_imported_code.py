"""A law from outside is named by its place and by the hash of its file; naming a law runs no code."""

import hashlib
import sys
from pathlib import Path

import pytest

import tests.laws
from trilat_net.core.plug.law_channel import LawChannel, SentVector
from trilat_net.core.step.site_step import Site
from trilat_net.errors import ScenarioError
from trilat_net.scenario import Scenario, load_scenario, parse_scenario

LAW = "tests.laws:Adaptive"
CODE = """
raise RuntimeError("it ran")
class Law: pass
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package whose modules must not be imported, in the current folder."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "trap_package").mkdir()
    for name in ("trap_package/__init__.py", "trap_package/trap.py", "trap_alone.py"):
        (tmp_path / name).write_text(CODE)
    return tmp_path


@pytest.mark.parametrize("module", ["trap_package.trap", "trap_package", "trap_alone"])
def test_naming_a_law_hashes_without_running(module: str, folder: Path) -> None:
    scenario = load_scenario("two_sites", {"control.law": f"{module}:Law", "control.gain": 3})
    file = folder / f"{module.replace('.', '/')}.py"
    file = file if file.exists() else folder / module / "__init__.py"
    for site in scenario.sites.values():
        assert site.control.source_sha256 == hashlib.sha256(file.read_bytes()).hexdigest()
        assert site.control.settings == {"gain": 3}
    assert parse_scenario(scenario.text) == scenario
    assert not {"trap_package", "trap_package.trap", "trap_alone"} & set(sys.modules)


def test_a_named_law_is_imported_only_where_defined(folder: Path) -> None:
    """The hash is that of the file: a class from elsewhere would not be covered by the hash."""
    (folder / "borrowed.py").write_text(
        "raise RuntimeError('it ran')\nfrom tests.laws import Adaptive\n"
    )
    scenario = load_scenario("two_sites", {"control.law": "borrowed:Adaptive"})
    with pytest.raises(ScenarioError, match="defines no class Adaptive"):
        Site(scenario.setup("s"))


@pytest.mark.parametrize(
    ("overrides", "fact"),
    [
        ({"control.law": "tests.laws:Missing"}, "defines no class Missing"),
        ({"control.law": "tests.laws:NoLaw"}, "NoLaw is not a law: the class has no torque"),
        (
            {"control.law": LAW, "control.Kdd": 2},
            "has no argument Kdd; its __init__ takes the arguments",
        ),
        ({"control.law": "tests.laws:Pair"}, "is for 2 sites, but the scenario has 3"),
        (
            {"control.law": "tests.laws:Odd"},
            "sites must be a number as in 2 or a range as in (2, 4), not 'many'",
        ),
    ],
)
def test_wrong_laws_are_refused_while_building(overrides: dict[str, object], fact: str) -> None:
    scenario = load_scenario("paper", overrides)
    with pytest.raises(ScenarioError) as caught:
        Site(scenario.setup("s"))
    assert fact in str(caught.value)
    assert caught.value.path.startswith("sites.s.control")


@pytest.mark.parametrize(
    ("name", "law"), [("two_sites", "Pair"), ("two_sites", "Few"), ("paper", "Few")]
)
def test_laws_for_several_sites_get_the_number(name: str, law: str) -> None:
    Site(load_scenario(name, {"control.law": f"tests.laws:{law}"}).setup("s"))


def test_laws_do_not_get_unknown_parameters() -> None:
    unknown = {"sites.s.plant": "external", "sites.s.arm.known": False}
    parameters = []

    class Listening(tests.laws.Adaptive):
        def __init__(self, facts: tests.laws.LawContext) -> None:
            super().__init__(facts)
            parameters.append(facts.theta)

    Site(load_scenario("two_sites", unknown).setup("s")._replace(law_factory=Listening))
    Site(load_scenario("two_sites").setup("s")._replace(law_factory=Listening))
    assert parameters == [(), (3.0, 1.0, 1.0, 2.0, 1.0)]
    scenario = load_scenario(
        "two_sites", {**unknown, "sites.s.control.law": "tests.laws:Knowing"}
    )
    with pytest.raises(ScenarioError, match=r"needs the arm's parameters, which are unknown"):
        Site(scenario.setup("s"))


def test_edited_law_files_are_taken_anew(folder: Path) -> None:
    file = folder / "edited_law.py"
    text = "from tests.laws import Adaptive\nclass Law(Adaptive):\n    theta_hat0 = {}\n"
    laws = []
    for value in ("1", "2.5"):
        file.write_text(text.format(value))
        site = Site(load_scenario("two_sites", {"control.law": "edited_law:Law"}).setup("s"))
        laws.append(site._user_law.theta_hat0)
    assert laws == [1, 2.5]


RESOLVED = load_scenario(
    "paper", {"control.law": LAW, "control.Kd": 2.0, "sites.m1.control.law": "adaptive"}
)


@pytest.mark.parametrize(
    ("overrides", "settings"),
    [
        (
            ["control.Lambda=4"],
            ({"Kd": 2.0}, {"Kd": 2.0}),
        ),  # m1 has it by a law of ours: its own
        (["control.gain=4"], ({"Kd": 2.0, "gain": 4},) * 2),
        (["control.settings.Kd=4"], ({"Kd": 4},) * 2),
        (["sites.s.control.Kd=4"], ({"Kd": 2.0}, {"Kd": 4})),
        (["sites.s.control.settings.Kd=4"], ({"Kd": 2.0}, {"Kd": 4})),
        ([f"control.law={LAW}", "control.gain=4"], ({"gain": 4},) * 2),
        ([f"sites.s.control.law={LAW}", "sites.s.control.gain=4"], ({"Kd": 2.0}, {"gain": 4})),
    ],
    ids=str,
)
def test_overrides_reach_the_arguments_of_laws(
    overrides: list[str], settings: tuple[dict[str, object], ...]
) -> None:
    changed = load_scenario(RESOLVED, overrides)
    assert tuple(changed.sites[name].control.settings for name in ("m2", "s")) == settings
    assert changed.sites["s"].control.code == LAW


def test_resolved_scenarios_use_no_other_file() -> None:
    other = load_scenario(
        RESOLVED.text.replace(RESOLVED.sites["s"].control.source_sha256, "0" * 64)
    )
    Site(RESOLVED.setup("s"))
    with pytest.raises(ScenarioError, match=r"its hash is not the permitted one") as caught:
        Site(other.setup("s"))
    assert caught.value.path == "sites.s.control.law"


SENDING = """
class Base: sends = {"never": {"unit": "m"}}
class Law(Base):
    sends = {SENDS}
    def torque(self): raise RuntimeError("it ran")
    memory = recall = torque
"""


def load_sending(folder: Path, sends: str) -> Scenario:
    """Returns a scenario of three sites whose law declares its messages."""
    (folder / "sending.py").write_text(SENDING.replace("{SENDS}", sends))
    return load_scenario("paper", {"control.law": "sending:Law"})


def test_messages_of_a_law_stand_in_scenarios(folder: Path) -> None:
    sends = (
        "{'u': {'unit': 'sqrt(W)', 'per_peer': True}, 'E': {'unit': 'J', 'length': 1}, 'w': {}}"
    )
    scenario = load_sending(folder, sends)
    assert parse_scenario(scenario.text) == scenario
    to_all = (SentVector("E", "J", 1), SentVector("w", "", 2))
    channel = LawChannel((*to_all, SentVector("u", "sqrt(W)", 2, per_peer=True)), peers=2)
    assert all(scenario.channel(site) == channel for site in scenario.names)
    assert channel.record_size == scenario.layout("s").lengths()["ch"] == 3 + 2 * 2
    for site in scenario.names:
        setup = scenario.setup(site)
        assert setup.channel == channel
        for link in setup.links:  # what is sent to this site is found in the peer's record
            record = list(range(channel.record_size))
            first = 3 + 2 * scenario.peers(link.peer).index(site)
            assert link.channel.select_for_peer(record, link.index_at_peer) == [
                0,
                1,
                2,
                first,
                first + 1,
            ]


def test_laws_without_messages_leave_scenarios_unchanged(folder: Path) -> None:
    scenario = load_sending(folder, "{}")
    assert "sends" not in scenario.text
    assert "ch" not in scenario.layout("s").lengths()
    assert scenario.setup("s").channel.record_size == 0


@pytest.mark.parametrize(
    ("sends", "key", "fact"),
    [
        ("make()", "law", "must be written out as a literal"),
        ("{'u': {}, 'u': {}}", "law", "contains the same name twice"),
        ("['u']", "law", "expected a table, got a list"),
        ("{'u': {'units': 'J'}}", "law", "unknown field units"),
        ("{'u': {'length': 0}}", "law", ">= 1"),
        ("{'u': {'length': 'arms'}}", "law", "arms"),
        ("{'two words': {}}", "sends.two words", "is not a valid name for a vector"),
        ("{'class': {}}", "sends.class", "is not a valid name for a vector"),
        ("{'T': {}}", "sends.T", "is reserved"),
        (
            "{'u': {'length': 20}, 'v': {'length': 13, 'per_peer': True}}",
            "sends",
            "33 numbers to each peer",
        ),
    ],
)
def test_invalid_messages_are_refused_while_reading(
    sends: str, key: str, fact: str, folder: Path
) -> None:
    with pytest.raises(ScenarioError) as caught:
        load_sending(folder, sends)
    assert caught.value.path in (f"control.{key}", f"sites.m1.control.{key}")
    assert fact in str(caught.value)


@pytest.mark.parametrize(
    ("sends", "overrides", "fact"),
    [
        ("{}", {}, "sends different vectors from those in the scenario"),
        (
            "{'u': {}}; schemes = ('digital',)",
            {},
            "is for scheme = 'digital', but the scheme here is 'second_order'",
        ),
        ("{'u': {}}; schemes = ('digital',)", {"scheme": "digital"}, ""),
    ],
)
def test_sites_get_their_named_law_and_scheme(
    sends: str, overrides: dict[str, object], fact: str, folder: Path
) -> None:
    scenario = load_sending(folder, "{'u': {}}")
    method = "def __init__(self, *_): raise OSError"
    file = folder / "sending.py"
    before = scenario.sites["s"].control.source_sha256
    file.write_text(SENDING.replace("{SENDS}", f"{sends}\n    {method}"))
    named = scenario.text.replace(before, hashlib.sha256(file.read_bytes()).hexdigest())
    scenario = load_scenario(load_scenario(named), overrides)
    with pytest.raises(ScenarioError, match=fact or "OSError"):
        Site(scenario.setup("s"))
    assert load_scenario(scenario, {"control.law": "adaptive"}).channel("s").record_size == 0
