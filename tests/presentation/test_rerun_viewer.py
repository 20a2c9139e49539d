"""Calls of Rerun: with the log itself, or with a file made from the log, and with its layout.

The content of the layout: every curve is in the file, has a name and shares a plot only with
its unit.
"""

import re
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest

from tests.log.builders import write_log
from tests.log.standard_files import SCENARIO
from tests.programs import RERUN, run_program
from trilat_net.errors import LogError, RunFailed, UsageError
from trilat_net.files import Extra
from trilat_net.log.log_reader import Log, open_log
from trilat_net.log.ros2.cdr import JOINT_STATE
from trilat_net.log.ros2.published import Ros2Topics
from trilat_net.log.ros2.ros2_messages import Ros2Channel
from trilat_net.presentation import rerun_viewer
from trilat_net.presentation.rerun_viewer import (
    PlotLayout,
    ViewerOptions,
    make_application_id,
    open_rerun,
)


class Rerun:
    """A stand-in for the program, which looks at its files when it is first called."""

    def __init__(self, code: int = 0) -> None:
        self.code = code
        self.command: list[str] = []
        self.environment: Mapping[str, str] = {}
        self.log = self.layout = Path()
        self.topics: set[str] = set()

    def __call__(self, command: list[str], environment: Mapping[str, str]) -> int:
        self.command = command
        self.environment = environment
        for file in map(Path, command):
            if file.suffix == ".mcap":
                self.log = file
                self.topics = set(Ros2Topics.of_file(file))
            if file.suffix == ".rbl":
                self.layout = file
                assert file.stat().st_size > 0
        return self.code


def run_viewer(
    paths: list[Path], show: ViewerOptions, code: int = 0
) -> tuple[Rerun, list[str]]:
    said: list[str] = []
    rerun = Rerun(code)
    open_rerun(paths, lambda: open_log(*paths), show, said.append, rerun)
    return rerun, said


def fail_to_read() -> Log:
    raise AssertionError("it was read")


@pytest.mark.long
def test_finished_logs_with_views_are_opened_directly(files: dict[str, Path]) -> None:
    rerun = Rerun()
    open_rerun([files["live"]], fail_to_read, ViewerOptions(web=True), lambda _: None, rerun)
    assert rerun.log == files["live"]
    assert rerun.command[:3] == [sys.executable, "-m", "rerun"]
    assert rerun.command[rerun.command.index("--bind") + 1] == "127.0.0.1"
    assert rerun.environment["RERUN_ANALYTICS_ENABLED"] == "false"


def test_temporary_files_end_with_the_viewer(files: dict[str, Path]) -> None:
    rerun, said = run_viewer([files["live"]], ViewerOptions(full=True, save=Path("x.rrd")))
    assert "/lab/m/joint_states" in rerun.topics
    assert said == ["making standard channels of every record ..."]
    assert not rerun.log.exists()
    assert not rerun.layout.exists()
    assert files["live"].exists()


def test_parts_and_torn_logs_are_shown_whole(files: dict[str, Path], tmp_path: Path) -> None:
    parts = sorted(files["first part"].parent.glob("parts-*.mcap"))
    torn = write_log(tmp_path, files["live"].read_bytes()[:150_000], "run.mcap.active")
    for paths, name in ((parts, parts[0].name), ([torn], "run.mcap")):
        rerun, _ = run_viewer(paths, ViewerOptions(save=Path("x.rrd")))
        assert rerun.log.name == name
        assert {"/lab/m/joint_states", "/lab/s/error"} <= rerun.topics


def test_names_unsuitable_for_rerun_are_replaced(
    files: dict[str, Path], tmp_path: Path
) -> None:
    """Rerun would find different names for the log and for its layout, and complain."""
    names = {
        "run.mcap": "run",
        "my run.2.mcap": "my-run-2",
        "-x.mcap.active": "x",
        "ü.mcap": "log",
    }
    assert {name: make_application_id(Path(name)) for name in names} == names
    write_log(tmp_path, files["live"].read_bytes(), "ü.mcap")
    rerun, _ = run_viewer([tmp_path / "ü.mcap"], ViewerOptions(save=Path("x.rrd")))
    assert rerun.log.stem == "log"
    assert "/viz/m/error" in rerun.topics


def test_browsers_get_an_address(files: dict[str, Path]) -> None:
    rerun, (message,) = run_viewer([files["live"]], ViewerOptions(web=True))
    page = rerun.command[rerun.command.index("--web-viewer-port") + 1]
    port = rerun.command[rerun.command.index("--port") + 1]
    assert "--serve-web" in rerun.command
    assert message.startswith(
        f"open http://127.0.0.1:{page}/?url=rerun%2Bhttp%3A%2F%2F127.0.0.1%3A{port}%2Fproxy"
    )


def test_a_window_needs_a_display(
    files: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr(rerun_viewer.sys, "platform", "linux")
    with pytest.raises(UsageError, match=r"no display here; .* web"):
        run_viewer([files["live"]], ViewerOptions())
    monkeypatch.setenv("DISPLAY", ":0")
    rerun, _ = run_viewer([files["live"]], ViewerOptions())
    assert "--serve-web" not in rerun.command
    assert "--save" not in rerun.command


def test_failures_are_reported(
    files: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    web = ViewerOptions(web=True)
    with pytest.raises(RunFailed, match="Rerun ended with exit code 3"):
        run_viewer([files["live"]], web, code=3)
    with pytest.raises(LogError, match="No such file"):
        run_viewer([tmp_path / "none.mcap"], web)
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(UsageError, match=re.escape(Extra("view").install_command)):
        run_viewer([files["live"]], web)


def test_rerun_takes_log_and_layout_into_one_recording(
    files: dict[str, Path], tmp_path: Path
) -> None:
    """The program itself: the layout is of the log's own application, so that Rerun applies it."""
    recording = tmp_path / "run.rrd"
    open_rerun([files["live"]], fail_to_read, ViewerOptions(save=recording), lambda _: None)
    text = run_program(*RERUN, "rrd", "print", "-vvv", str(recording))
    stores = set(re.findall(r'(Blueprint|Recording),\s*"([^"]+)"', text))
    assert stores == {("Blueprint", "live"), ("Recording", "live")}
    assert [name for name in Ros2Topics.of_file(files["live"]) if name not in text] == []


def build_layouts(
    files: dict[str, Path],
) -> dict[str, tuple[dict[str, Ros2Channel], PlotLayout]]:
    return {
        kind: (Ros2Topics.of_file(path), PlotLayout.of_channels(Ros2Topics.of_file(path)))
        for kind, path in files.items()
    }


def test_every_curve_is_in_the_file(files: dict[str, Path]) -> None:
    for channels, panels in build_layouts(files).values():
        for page in panels.pages.values():
            for plot in (plot for row in page for plot in row):
                for entity, names, visible in plot.curves:
                    topic = entity if entity in channels else entity.rpartition("/")[0]
                    assert topic in channels
                    assert len(names) == len(visible) == len(set(names)) > 0
                    assert all(names)


def test_sites_are_columns_and_quantities_rows(files: dict[str, Path]) -> None:
    channels, panels = build_layouts(files)["live"]
    assert list(panels.pages) == ["Motion", "Speeds, estimates", "Links, timing"]
    for page in panels.pages.values():
        for row in page:
            assert [plot.title.partition(":")[0] for plot in row] == list(SCENARIO.names)
    first = panels.pages["Motion"][0][0]
    assert first.title == "m: joint angles and reference (rad)"
    assert first.curves[0].names == ("m_q1", "m_q2", "m_q1_ref", "m_q2_ref")
    assert panels.lines == "/viz/log"
    assert {"/viz/log", "/viz/events"} <= set(channels)


def test_a_bag_shows_the_reference_beside_the_joints(
    files: dict[str, Path],
) -> None:
    of = build_layouts(files)
    bag = of["bag"][1].pages["Motion"]
    views = of["live"][1].pages["Motion"]
    assert [c.entity for c in bag[0][0].curves] == [
        "/lab/m/joint_states/position",
        "/lab/m/reference/position",
    ]
    assert bag[0][0].curves[1].names == ("m_q1_ref", "m_q2_ref")
    assert [c.entity for c in bag[2][0].curves] == [
        "/lab/m/joint_states/effort",
        "/lab/m/tau_x",
    ]
    assert views[2][0].curves[0].visible == (True, True, False, False)
    assert of["bag"][1].lines == "/lab/log"


def test_missing_quantities_take_no_room(files: dict[str, Path]) -> None:
    rows = build_layouts(files)["virtual"][1].pages["Links, timing"]
    assert [row[0].title for row in rows] == ["m: age of samples in use, by peer (ms)"]
    assert PlotLayout.of_channels({}) == PlotLayout({}, "")
    assert (
        PlotLayout.of_channels(
            {"/viz/a/joint_states": Ros2Channel(JOINT_STATE, {"names": "a_q1"})}
        ).lines
        == ""
    )


def test_two_dimensional_numbers_are_named_by_both(files: dict[str, Path]) -> None:
    delays = build_layouts(files)["live"][1].pages["Links, timing"][1]
    assert delays[0].curves[0].names == ("s median", "s max")


def test_files_without_index_have_no_channels(files: dict[str, Path], tmp_path: Path) -> None:
    for content in (b"", b"nonsense" * 100, files["live"].read_bytes()[:50_000]):
        write_log(tmp_path, content, "x.mcap")
        assert Ros2Topics.of_file(tmp_path / "x.mcap") == {}
