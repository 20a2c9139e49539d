"""The page of a map, and its figure: colours are the verdicts, borders lie half way, lines on top."""

from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.collections import QuadMesh
from matplotlib.colors import rgb_to_hsv, to_hex, to_rgb
from matplotlib.contour import QuadContourSet
from matplotlib.figure import Figure
from study_builders import (
    DAMPINGS,
    DELAYS_MS,
    SPARE_DAMPING,
    judge_by_condition,
    make_gapped_plane,
    make_map_plane,
    read_tables,
)
from trilat_studies.sweep.fixed_gains import describe_fixed_gains
from trilat_studies.sweep.map_page import CLASS_COLOURS, MapReport
from trilat_studies.sweep.map_plane import CELL_CLASSES, MapPlane
from trilat_studies.sweep.stability_map import MapLine, StabilityMap
from trilat_studies.sweep.sweep_cell import CellClass
from trilat_studies.sweep.sweep_plan import plan_sweep

from trilat_net.presentation.appearance import FigureSize

EXACT = MapLine("$d$", "d = 5 T", "the condition", SPARE_DAMPING, 0)
HALF = MapLine(
    "half",
    "half of it",
    "half of the condition",
    SPARE_DAMPING + 2.5e-3 * np.array(DELAYS_MS),
    1,
)


@pytest.fixture
def chart() -> StabilityMap:
    plane = make_map_plane(link__playout_ms=(0.0, 400.0))
    return StabilityMap(
        plane, ((EXACT, HALF), (EXACT,)), ("a remark",), ("trilat sweep a", "trilat map"), "P+d"
    )


def test_folder_has_a_picture_vector_and_page(chart: StabilityMap, tmp_path: Path) -> None:
    paths = MapReport(chart).write(tmp_path)
    assert [path.name for path in paths] == ["map.png", "map.svg", "map.pdf", "map.md"]
    # 3.5 in, 300 pixels to the inch
    assert int.from_bytes(paths[0].read_bytes()[16:20], "big") == 1050
    assert paths[1].read_text().startswith("<?xml")


@pytest.mark.long
def test_equal_results_give_equal_bytes(chart: StabilityMap, tmp_path: Path) -> None:
    other_folder = tmp_path / "again"
    other_folder.mkdir()
    for file, same_file in zip(
        MapReport(chart).write(tmp_path), MapReport(chart).write(other_folder), strict=True
    ):
        assert file.read_bytes() == same_file.read_bytes()


def test_the_page_shows_commands_lines_and_remarks(chart: StabilityMap) -> None:
    text = MapReport(chart).build_page("map.png")
    assert text.startswith("# P+d\n")
    assert "trilat sweep a\ntrilat map\n```" in text
    assert "![map](map.png)" in text
    assert text.count("d = 5 T: the condition") == 1
    assert "- a remark" in text
    assert "## playout 0 ms" in text


def read_map_tables(plane: MapPlane, *lines: MapLine) -> list[list[tuple[str, ...]]]:
    """Returns the tables of the page of a map: that of the classes, then that of the edges."""
    chart = StabilityMap(plane, (lines,), (), (), "map")
    return read_tables(MapReport(chart).build_page("map.png"))


def test_counts_are_of_all_runs() -> None:
    plane = make_map_plane(lambda _x, _y, seed: list(CellClass)[seed - 1], seeds=3)
    _, *rows = read_map_tables(plane)[0]
    assert rows == [("all", "25", "25", "25", "0")]


def test_an_edge_stands_beside_each_lines_difference() -> None:
    """A row has the measured edge, then each line's edge and its distance from the middle."""
    _, (heads, *rows) = read_map_tables(make_map_plane(), EXACT, HALF)
    measured_heads = ("delay (ms)", "edge of d (N m s/rad)", "stable is")
    line_heads = ("d = 5 T", "difference", "half of it", "difference")
    assert heads == (*measured_heads, *line_heads)
    assert [row[0] for row in rows] == ["100", "200", "300", "400"]
    for row in rows:
        low, high = map(float, row[1].split(" to "))
        assert row[2] == "above"
        assert low <= float(row[3]) <= high
        assert row[4] == "within"

        half = 2.5e-3 * float(row[0])
        middle = 0.5 * (low + high)
        expected = "within" if low <= half <= high else f"{100 * (half / middle - 1):+.1f} %"
        assert row[6] == expected


def test_a_missing_line_has_no_difference() -> None:
    missing_line = EXACT._replace(excess=np.full((5, 5), np.nan))
    _, (_, *rows) = read_map_tables(make_map_plane(), missing_line)
    assert [row[-2:] for row in rows] == [("-", "-")] * 4


def test_a_map_without_an_edge_has_no_table() -> None:
    plane = make_map_plane(lambda *_, **__: CellClass.CONVERGED)
    assert len(read_map_tables(plane, EXACT)) == 1  # only that of the classes


LINE = MapLine("$d$", "d", "", SPARE_DAMPING, 0)


def figure(plane: MapPlane, width_in: float = 3.5, lines: tuple[MapLine, ...] = ()) -> Figure:
    """Draws the map of a plane, with the same lines in each panel."""
    chart = StabilityMap(plane, (lines,) * len(plane.panels), (), (), "map")
    return MapReport(chart).draw(FigureSize.for_print(width_in))


def meshes(figure_of_map: Figure) -> list[QuadMesh]:
    """Returns the coloured grids of a figure, one for each panel."""
    return [
        collection
        for axes in figure_of_map.axes
        for collection in axes.collections
        if isinstance(collection, QuadMesh)
    ]


def choose_class(delay_ms: int, damping: float, _seed: int = 1) -> CellClass:
    """Returns a verdict for each cell, so that all verdicts occur."""
    return CELL_CLASSES[(DELAYS_MS.index(delay_ms) + DAMPINGS.index(damping)) % 4]


def test_every_place_has_the_colour_of_its_verdict() -> None:
    figure_of_map = figure(make_map_plane(choose_class))
    figure_of_map.canvas.draw()
    (mesh,) = meshes(figure_of_map)[:1]
    colours = mesh.get_facecolors().reshape(len(DAMPINGS), len(DELAYS_MS), 4)
    for i, d in enumerate(DAMPINGS):
        for j, delay in enumerate(DELAYS_MS):
            assert to_hex(colours[i, j]) == CLASS_COLOURS[choose_class(delay, d)]


def test_a_place_reaches_half_way_to_the_next() -> None:
    (mesh,) = meshes(figure(make_map_plane()))[:1]
    corners = mesh.get_coordinates()
    assert np.allclose(corners[0, :, 0], [0, 50, 150, 250, 350, 450])
    assert np.allclose(corners[:, 0, 1], [0, 0.45, 0.95, 1.45, 1.95, 2.45])


def test_classes_differ_in_lightness() -> None:
    """In grey print the classes differ by their luminance (Rec. 709), and undecided is white."""
    light = [
        float(np.dot(to_rgb(CLASS_COLOURS[v]), (0.2126, 0.7152, 0.0722))) for v in CELL_CLASSES
    ]
    assert min(abs(a - b) for n, a in enumerate(light) for b in light[:n]) > 0.09
    assert rgb_to_hsv(to_rgb(CLASS_COLOURS[CellClass.UNDECIDED]))[1] == 0.0


def test_lines_are_drawn_where_they_are_and_named() -> None:
    """Two lines along d = 5 T are straight, differ in their style, and are in the legend."""
    figure_of_lines = figure(
        make_map_plane(), lines=(LINE, LINE._replace(label="linear analysis", rank=1))
    )
    first, second = (
        collection
        for collection in figure_of_lines.axes[0].collections
        if isinstance(collection, QuadContourSet)
    )

    for line in (first, second):
        ends = np.concatenate([path.vertices for path in line.get_paths()])
        assert np.allclose(ends[:, 1], 5e-3 * ends[:, 0])
        assert ends[:, 1].max() - ends[:, 1].min() > 2.0
    assert first.get_linestyle() != second.get_linestyle()

    (legend,) = figure_of_lines.legends
    label_texts = [text.get_text() for text in legend.get_texts()]
    assert label_texts == ["converged", "bounded oscillation", "$d$", "linear analysis"]


def test_the_legend_has_only_occurring_classes() -> None:
    (legend,) = figure(make_map_plane(lambda *_, **__: CellClass.UNDECIDED)).legends
    assert [text.get_text() for text in legend.get_texts()] == ["undecided"]


def test_several_runs_show_their_share_with_a_scale() -> None:
    """A cell has the colour of its share, and a count if its seeds disagree."""
    plane = make_map_plane(lambda x, y, seed: judge_by_condition(x, y - 0.3 * seed), seeds=4)
    figure_of_runs = figure(plane, 7.0)
    share = meshes(figure_of_runs)[0].get_array()
    assert share is not None
    assert np.allclose(np.ma.getdata(share), plane.panels[0].share)
    assert "share of stable runs" in [axes.get_ylabel() for axes in figure_of_runs.axes]

    texts = {text.get_text() for text in figure_of_runs.axes[0].texts}
    assert texts
    for i, j in np.argwhere((plane.panels[0].share > 0.0) & (plane.panels[0].share < 1.0)):
        assert f"{round(4 * plane.panels[0].share[i, j])}/4" in texts
    assert not any(text in ("0/4", "4/4") for text in texts)


@pytest.mark.parametrize(("panels", "width_in"), [(1, 3.5), (3, 3.5), (6, 7.0)])
def test_panels_have_titles_and_share_one_label(panels: int, width_in: float) -> None:
    plane = make_map_plane(rate_hz=tuple(float(n) for n in range(1, panels + 1)))
    figure_of_panels = figure(plane, width_in, (LINE,))
    assert figure_of_panels.get_figwidth() == width_in
    assert [axes.get_title() for axes in figure_of_panels.axes if axes.collections] == [
        p.title for p in plane.panels
    ]
    labels = [
        figure_of_panels.get_supxlabel(),
        *(axes.get_xlabel() for axes in figure_of_panels.axes),
    ]
    assert [text for text in labels if text] == ["delay (ms)"]


def test_settings_of_matplotlib_stay_unchanged() -> None:
    before = dict(mpl.rcParams)
    figure(make_map_plane())
    assert dict(mpl.rcParams) == before


def test_a_place_without_run_is_no_verdict() -> None:
    classes = meshes(figure(make_gapped_plane()))[0].get_array()
    assert classes is not None
    assert int(np.ma.getmaskarray(classes).sum()) == 1


def test_uneven_values_are_named_one_by_one() -> None:
    plane = make_map_plane()
    uneven = plane._replace(x=plane.x._replace(values=(8, 68, 136, 272, 1088)))
    figure_of_values = figure(uneven)
    figure_of_values.canvas.draw()
    assert [text.get_text() for text in figure_of_values.axes[0].get_xticklabels()] == [
        "8",
        "68",
        "136",
        "272",
        "1088",
    ]


FIXED = ("p_d: K 10, gravity 1", "adaptive: Lambda 1, Kp 1, Kd 3, Gamma 1, theta_hat0 0")


@pytest.mark.parametrize("panels", [(0.0,), (0.0, 400.0)])
@pytest.mark.parametrize("width_in", [3.5, 7.0])
def test_a_caption_covers_no_label(panels: tuple[float, ...], width_in: float) -> None:
    """The gains below the panels stand apart from every label and inside the figure."""
    plane = make_map_plane(link__playout_ms=panels)
    chart = StabilityMap(plane, ((),) * len(plane.panels), (), (), "map", FIXED)
    figure = MapReport(chart).draw(FigureSize.for_print(width_in))
    figure.draw_without_rendering()
    (caption,) = figure.texts[:1]
    box = caption.get_window_extent()
    assert box.x1 <= figure.bbox.width

    others = [axes.get_tightbbox() for axes in figure.axes]
    others += [text.get_window_extent() for text in figure.texts[1:]]
    for text in (figure._supxlabel, figure._supylabel):  # type: ignore[attr-defined]
        others += [text.get_window_extent()] if text is not None else []
    for other in others:
        assert other is not None
        assert not box.overlaps(other)

    caption_text = " ".join(caption.get_text().split())
    assert caption_text.startswith(f"not swept: {'; '.join(FIXED)}")
    assert "trilat compare --tune" in caption_text


@pytest.mark.parametrize(
    ("axes", "laws", "texts"),
    [
        (["link.delay_ms=20,40", "control.d=1,2"], [], ["p_d: K 10, gravity 1"]),
        (
            ["sites.s.control.d=1,2"],
            [],
            ["p_d of m1, m2: K 10, d 1.1, gravity 1", "p_d of s: K 10, gravity 1"],
        ),
        (["rate_hz=500,1000"], ["p_d", "pd_d"], ["p_d: K 10, d 1.1, gravity 1", "pd_d: "]),
        (["control.K=1,2", "control.d=1,2", "control.gravity=0,1"], [], ["p_d: none"]),
    ],
)
def test_gains_that_were_not_swept_are_named(
    axes: list[str], laws: list[str], texts: list[str]
) -> None:
    gains = describe_fixed_gains(plan_sweep("p_d_margin", over=axes, laws=laws))
    assert len(gains) == len(texts)
    for sentence, text in zip(gains, texts, strict=True):
        assert sentence.startswith(text)
