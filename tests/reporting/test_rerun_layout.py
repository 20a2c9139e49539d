"""What is shown where: every curve is in the file, has a name and shares a plot with its unit alone."""

from pathlib import Path

from tests.log.standard_files import SCENARIO
from trilat_net.log.ros2.cdr import JOINT_STATE
from trilat_net.log.ros2.ros2_messages import Ros2Channel, read_ros2_channels
from trilat_net.reporting.rerun_viewer import PlotLayout, build_plot_layout


def boards(files: dict[str, Path]) -> dict[str, tuple[dict[str, Ros2Channel], PlotLayout]]:
    return {
        kind: (read_ros2_channels(path), build_plot_layout(read_ros2_channels(path)))
        for kind, path in files.items()
    }


def test_every_curve_is_of_a_channel_in_the_file(files: dict[str, Path]) -> None:
    for channels, shown in boards(files).values():
        for page in shown.pages.values():
            for plot in (plot for row in page for plot in row):
                for entity, names, visible in plot.curves:
                    topic = entity if entity in channels else entity.rpartition("/")[0]
                    assert topic in channels
                    assert len(names) == len(visible) == len(set(names)) > 0
                    assert all(names)


def test_every_site_has_its_column_and_every_quantity_its_row(files: dict[str, Path]) -> None:
    channels, shown = boards(files)["live"]
    assert list(shown.pages) == ["Motion", "Speeds, estimates", "Links, timing"]
    for page in shown.pages.values():
        for row in page:
            assert [plot.title.partition(":")[0] for plot in row] == list(SCENARIO.names)
    first = shown.pages["Motion"][0][0]
    assert first.title == "m: joint angles and reference (rad)"
    assert first.curves[0].names == ("m_q1", "m_q2", "m_q1_ref", "m_q2_ref")
    assert shown.lines == "/viz/log"
    assert {"/viz/log", "/viz/events"} <= set(channels)


def test_a_bag_shows_the_reference_beside_the_joints(
    files: dict[str, Path],
) -> None:
    of = boards(files)
    bag, views = of["bag"][1].pages["Motion"], of["live"][1].pages["Motion"]
    assert [c.entity for c in bag[0][0].curves] == ["/m/joint_states/position", "/m/reference/position"]
    assert bag[0][0].curves[1].names == ("m_q1_ref", "m_q2_ref")
    assert [c.entity for c in bag[2][0].curves] == ["/m/joint_states/effort", "/m/tau_x"]
    assert views[2][0].curves[0].shown == (True, True, False, False)
    assert of["bag"][1].lines == "/log"


def test_what_there_is_not_takes_no_room(files: dict[str, Path]) -> None:
    rows = boards(files)["virtual"][1].pages["Links, timing"]
    assert [row[0].title for row in rows] == ["m: age of samples in use, by peer (ms)"]
    assert build_plot_layout({}) == PlotLayout({}, "")
    assert build_plot_layout({"/viz/a/joint_states": Ros2Channel(JOINT_STATE, {"names": "a_q1"})}).lines == ""


def test_a_number_of_two_dimensions_has_the_name_of_both(files: dict[str, Path]) -> None:
    delays = boards(files)["live"][1].pages["Links, timing"][1]
    assert delays[0].curves[0].names == ("s median", "s max")


def test_a_file_without_an_index_has_no_channels_to_show(files: dict[str, Path], tmp_path: Path) -> None:
    for content in (b"", b"nonsense" * 100, files["live"].read_bytes()[:50_000]):
        (tmp_path / "x.mcap").write_bytes(content)
        assert read_ros2_channels(tmp_path / "x.mcap") == {}
