"""The layout for Foxglove and Lichtblick: every message path names a number that the file has."""

import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

import trilat_net as tn
from tests.cli.running import trilat
from tests.log.builders import write_log
from tests.scenario.builders import planar_task_text
from trilat_net.errors import UsageError
from trilat_net.presentation.foxglove_layout import write_foxglove_layout

PATH = re.compile(r"(?P<topic>(/\w+)+)\.(?P<fields>[\w.]+)(\[(?P<index>\d+)\])?")
"""What our layouts use of the syntax of message paths: /topic.field.field[0]."""
LIVE_ONLY = {"link_delay", "link_offset", "timing"}
"""Topics that virtual time does not have, because no clock was read."""


def first_messages(file: Path) -> dict[str, object]:
    """Returns the first message of each topic that the schemas of the file can decode."""
    messages: dict[str, object] = {}
    with file.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        topics = [c.topic for c in summary.channels.values() if c.message_encoding == "cdr"]
        for _, channel, _, message in reader.iter_decoded_messages(topics):
            messages.setdefault(channel.topic, message)
    return messages


def resolve_path(path: str, messages: Mapping[str, object]) -> object:
    """Returns the value to which a message path leads; an error if there is none."""
    parts = PATH.fullmatch(path)
    assert parts is not None, path
    value = messages[parts["topic"]]
    for field in parts["fields"].split("."):
        value = getattr(value, field)
    return value if parts["index"] is None else value[int(parts["index"])]


def list_panels(layout: Mapping, kind: str) -> list[Mapping]:
    return [s for name, s in layout["configById"].items() if name.split("!")[0] == kind]


def list_paths(layout: Mapping, kind: str) -> list[str]:
    return [line["value"] for panel in list_panels(layout, kind) for line in panel["paths"]]


def iterate_panels(tree: object) -> Iterator[str]:
    """Yields the panels in a tree and in the tabs that it contains."""
    if isinstance(tree, str):
        yield tree
    else:
        yield from iterate_panels(tree["first"])
        yield from iterate_panels(tree["second"])


def read_layout(file: Path) -> dict:
    return json.loads(write_foxglove_layout(file, force=True).read_text())


@pytest.fixture(scope="module")
def paper(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A log of the paper's scenario, and the bag with the topics of a running session."""
    folder = tmp_path_factory.mktemp("paper")
    log = tn.simulate("paper", duration_s=0.25)
    return log.save(folder / "run.mcap"), tn.export(log, "ros2", folder / "bag.mcap")


def test_paths_of_the_paper_lead_to_numbers(paper: tuple[Path, Path]) -> None:
    log, bag = paper
    messages = first_messages(log) | first_messages(bag)
    layout = read_layout(log)
    drawn = list_paths(layout, "Plot")
    assert len(drawn) == len(set(drawn))
    for path in drawn:
        topic = PATH.fullmatch(path)["topic"]
        if topic not in messages:
            assert topic.split("/")[-1] in LIVE_ONLY, path
        else:
            assert isinstance(resolve_path(path, messages), float), path
    modes = [resolve_path(path, messages) for path in list_paths(layout, "StateTransitions")]
    assert modes == [1.0, 1.0, 1.0, "run", "run", "run"]


def test_the_paper_shows_all_kinds_of_quantities(
    paper: tuple[Path, Path],
) -> None:
    drawn = set(list_paths(read_layout(paper[0]), "Plot"))
    for site in ("m1", "m2", "s"):
        for index in range(2):
            root = f"/viz/{site}"
            assert {
                f"{root}/joint_states.position[{index}]",
                f"{root}/joint_states.position[{index + 2}]",
                f"{root}/joint_states.velocity[{index}]",
                f"{root}/joint_states.effort[{index}]",
                f"{root}/error.data[{index}]",
                f"{root}/link_age.data[{index}]",
            } <= drawn
        assert f"/viz/{site}/theta_hat.data[4]" in drawn


def test_paths_of_recorded_sessions_lead_to_numbers(files: dict[str, Path]) -> None:
    messages = first_messages(files["live"]) | first_messages(files["bag"])
    layout = read_layout(files["live"])
    for path in list_paths(layout, "Plot"):
        assert isinstance(resolve_path(path, messages), float), path
    reached = {
        PATH.fullmatch(path)["topic"].split("/")[-1] for path in list_paths(layout, "Plot")
    }
    assert reached >= LIVE_ONLY
    for panel in list_panels(layout, "RosOut"):
        assert hasattr(messages[panel["topicToRender"]], "msg")


@pytest.mark.parametrize(
    "path",
    [
        "/viz/m9/error.data[0]",
        "/viz/m1/errors.data[0]",
        "/viz/m1/error.values[0]",
        "/viz/m1/error.data[2]",
        "/viz/m1/joint_states.positions[0]",
        "/viz/m1/error data[0]",
    ],
)
def test_a_wrong_path_leads_nowhere(paper: tuple[Path, Path], path: str) -> None:
    with pytest.raises((KeyError, AttributeError, IndexError, AssertionError)):
        resolve_path(path, first_messages(paper[0]))


def test_arms_have_their_urdf_and_their_frames(paper: tuple[Path, Path]) -> None:
    _, bag = paper
    messages = first_messages(bag)
    (scene,) = list_panels(read_layout(bag), "3D")
    arms = [layer for layer in scene["layers"].values() if layer["layerId"] == "foxglove.Urdf"]
    assert [arm["label"] for arm in arms] == ["m1", "m2", "s"]
    for arm in arms:
        assert "<robot" in messages[arm["topic"]].data
    assert scene["followTf"] in {t.header.frame_id for t in messages["/tf"].transforms}
    for topic in scene["topics"]:
        assert hasattr(messages[topic].pose, "orientation")


@pytest.mark.long
def test_a_log_of_urdf_arms_shows_them_itself(tmp_path: Path) -> None:
    log = tn.simulate("seven_joints", duration_s=0.05).save(tmp_path / "run.mcap")
    messages = first_messages(log)
    layout = read_layout(log)
    scene = list_panels(layout, "3D")[0]
    topics = [layer["topic"] for layer in scene["layers"].values() if "topic" in layer]
    assert topics
    for topic in topics:
        assert "<robot" in messages[topic].data
    for path in list_paths(layout, "Plot"):
        if path.startswith("/viz/"):
            assert isinstance(resolve_path(path, messages), float), path


def test_sites_that_share_poses_have_plots_too(tmp_path: Path) -> None:
    log = tn.simulate(planar_task_text(), duration_s=0.05)
    file = log.save(tmp_path / "run.mcap")
    messages = first_messages(file) | first_messages(
        tn.export(log, "ros2", tmp_path / "b.mcap")
    )
    for path in list_paths(read_layout(file), "Plot"):
        if PATH.fullmatch(path)["topic"].split("/")[-1] not in LIVE_ONLY:
            assert isinstance(resolve_path(path, messages), float), path


def test_every_panel_stands_in_the_tree_once(paper: tuple[Path, Path]) -> None:
    layout = read_layout(paper[0])
    tabs = [tab for panel in list_panels(layout, "Tab") for tab in panel["tabs"]]
    trees = [layout["layout"], *(tab["layout"] for tab in tabs)]
    placed = [panel for tree in trees for panel in iterate_panels(tree)]
    assert sorted(placed) == sorted(layout["configById"])
    assert {tab["title"] for tab in tabs} >= {"Log", "ROS 2", "Motion", "Arms"}


def test_equal_logs_have_equal_layouts(paper: tuple[Path, Path], tmp_path: Path) -> None:
    again = tn.simulate("paper", duration_s=0.25).save(tmp_path / "other.mcap")
    layouts = [write_foxglove_layout(file, force=True) for file in (paper[0], again)]
    assert layouts[0].read_bytes() == layouts[1].read_bytes()


def test_an_existing_layout_is_kept(tmp_path: Path) -> None:
    log = tn.simulate("two_sites", duration_s=0.05).save(tmp_path / "run.mcap")
    tn.view(log, foxglove=True)
    with pytest.raises(UsageError, match="already exists"):
        tn.view(log, foxglove=True)
    with pytest.raises(UsageError, match="cannot be combined"):
        tn.view(log, foxglove=True, full=True)


def test_the_command_says_how_to_use_it(paper: tuple[Path, Path], tmp_path: Path) -> None:
    write_log(tmp_path, paper[0].read_bytes())
    view = ("log", "view", "run.mcap", "--foxglove")
    assert trilat(*view, cwd=tmp_path).succeeds() == (
        "run.foxglove.json: open run.mcap in Foxglove or Lichtblick, and import this file as "
        "a layout\n"
    )
    trilat(*view, cwd=tmp_path).refuses("run.foxglove.json already exists", "--force")
    trilat(*view, "--force", cwd=tmp_path).succeeds()
    advice = trilat("log", "view", "run.mcap", "--rviz", cwd=tmp_path).succeeds()
    assert advice.splitlines() == [
        "run.rviz: during a session with `trilat ros2`, run: rviz2 -d run.rviz",
        "  for a bag: ros2 bag play BAG --clock 100, and rviz2 -d run.rviz --ros-args -p use_sim_time:=true",
    ]
    assert "rviz_default_plugins/RobotModel" in (tmp_path / "run.rviz").read_text()
    trilat(*view, "--web", cwd=tmp_path).refuses("--foxglove and --rviz cannot be combined")


def test_a_file_without_channels_says_what_to_do(tmp_path: Path) -> None:
    off = ("sim", "two_sites", "--duration", "0.05", "--views", "off", "-o", "off.mcap")
    trilat(*off, cwd=tmp_path).succeeds()
    refused = trilat("log", "view", "off.mcap", "--foxglove", cwd=tmp_path)
    refused.refuses(
        "off.mcap: there is nothing to plot", "trilat log export off.mcap --to ros2"
    )
    assert not list(tmp_path.glob("*.json"))
