"""The notebooks of `examples/` run, and their stated facts hold; they are stored without outputs."""

import json
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[1] / "examples"
FACTS = {
    "paper": [
        'assert str(judged.stability) == "stable"',
        'assert abs(ends["with operators"] - ends["without"]).max() < 2e-4',
        "assert again.passed",
    ],
    "my_law": [
        'calm, far = table["torque step, mN m"], table["RMS spread, rad"]',
        'assert calm["mine, 20 ms"] < 0.65 * calm["P+d"]',
        'assert 1.15 < far["mine, 20 ms"] / far["P+d"] < 1.25',
        'assert list(table["certificate"]) == ["settled", "open", "open"]',
        "assert list(asked.values()) == sorted(asked.values())",
    ],
    "map": [
        "assert agree.all()",
        "assert all(value < delay_ms / 200 for delay_ms, value in edge.items())",
        "assert abs(edge[400] - 1.765) < 1e-3",
    ],
    "field_log": [
        "assert sound.passed",
        "assert verified.passed",
        'assert network.loc["loss"].min() > 0.0',
    ],
}
"""By notebook what holds at its end, in Python."""


def test_every_notebook_has_facts_and_no_outputs() -> None:
    assert {path.stem for path in FOLDER.glob("*.ipynb")} == FACTS.keys()
    for path in FOLDER.glob("*.ipynb"):
        for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
            assert not cell.get("outputs"), path.name
            assert cell.get("execution_count") is None, path.name


@pytest.mark.long
@pytest.mark.filterwarnings("default")  # of its packages
@pytest.mark.parametrize("name", FACTS)
def test_a_notebook_runs_and_its_facts_hold(name: str, tmp_path: Path) -> None:
    nbclient = pytest.importorskip("nbclient", reason="make test-long installs it")
    nbformat = pytest.importorskip("nbformat")
    pytest.importorskip("ipykernel")
    notebook = nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)
    notebook.cells.append(nbformat.v4.new_code_cell("\n".join(FACTS[name])))
    where = {"metadata": {"path": str(tmp_path)}}
    nbclient.NotebookClient(
        notebook, timeout=1200, kernel_name="python3", resources=where
    ).execute()


SHOWN = {
    "tn.figure(log)": "image/png",
    'tn.figure(log, "positions")': "image/png",
    'log["m1"]': "text/html",
    "log": "text/html",
    "tn.metrics(log)": "text/html",
    "tn.verify(log)": "text/html",
}
"""By expression what a notebook shows of its value, at least."""


@pytest.mark.long
@pytest.mark.filterwarnings("default")  # of its packages
def test_values_show_themselves_in_a_notebook(tmp_path: Path) -> None:
    nbclient = pytest.importorskip("nbclient", reason="make test-long installs it")
    nbformat = pytest.importorskip("nbformat")
    pytest.importorskip("ipykernel")
    begin = 'import trilat_net as tn\nlog = tn.simulate("paper", duration_s=0.5)'
    cells = [nbformat.v4.new_code_cell(text) for text in (begin, *SHOWN)]
    notebook = nbformat.v4.new_notebook(cells=cells)
    where = {"metadata": {"path": str(tmp_path)}}
    nbclient.NotebookClient(
        notebook, timeout=600, kernel_name="python3", resources=where
    ).execute()
    for cell, kind in zip(notebook.cells[1:], SHOWN.values(), strict=True):
        (output,) = (
            cell_output
            for cell_output in cell.outputs
            if cell_output.output_type == "execute_result"
        )
        assert kind in output.data, cell.source
        assert len(output.data[kind]) > 200, cell.source
