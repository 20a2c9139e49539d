"""The summaries of the suite in docs/data agree with the tables of its cells."""

import csv
import re
from collections import Counter
from pathlib import Path

import pytest

DATA = Path(__file__).parents[4] / "docs" / "data"
JUDGEMENTS = ("stable", "settled", "open", "not stable")


def read_cells(name: str) -> list[dict[str, str]]:
    with (DATA / name).open(newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def read_rows(name: str) -> list[list[str]]:
    """Returns the rows of a summary without its header."""
    with (DATA / name).open(newline="", encoding="utf-8") as stream:
        return list(csv.reader(stream))[1:]


def is_exact(link: str) -> bool:
    """True if the delays of the link are constant or recorded."""
    return re.fullmatch(r"rtt\d+|trace", link) is not None


def test_each_law_has_the_judgements_of_its_cells() -> None:
    cells = read_cells("bench.csv")
    rows = read_rows("bench-laws.csv")
    assert {row[0] for row in rows} == {cell["law"] for cell in cells}
    for row in rows:
        counted = Counter(
            (is_exact(cell["link"]), cell["judgement"])
            for cell in cells
            if cell["law"] == row[0]
        )
        expected = [counted[exact, word] for exact in (True, False) for word in JUDGEMENTS]
        assert [int(number) for number in row[1:9]] == expected, row[0]


def test_errors_and_stiffness_are_those_at_68_ms() -> None:
    cells = {
        (cell["law"], cell["task"]): cell
        for cell in read_cells("bench.csv")
        if cell["link"] == "rtt68"
    }
    for law, *_, free, contact, stiffness in read_rows("bench-laws.csv"):
        expected = (
            cells[law, "free"]["error_rad"],
            cells[law, "contact"]["error_rad"],
            cells[law, "contact"]["stiffness_n_m"],
        )
        for stated, measured in zip((free, contact, stiffness), expected, strict=True):
            assert bool(stated) == bool(measured), law
            if stated:
                assert float(stated) == pytest.approx(float(measured), rel=5e-3), law


def test_ratios_of_errors_follow_from_cells() -> None:
    errors_rad = {
        (cell["task"], cell["law"], cell["link"]): float(cell["error_rad"])
        for cell in read_cells("bench-round-trips.csv")
        if cell["error_rad"]
    }
    rows = read_rows("bench-round-trips-ratios.csv")
    assert len(rows) == 14
    for task, law, shortest_rad, growth, loss_growth in rows:
        error_rad = errors_rad[task, law, "rtt8"]
        assert float(shortest_rad) == error_rad
        assert float(growth) == pytest.approx(
            errors_rad[task, law, "rtt1088"] / error_rad, rel=5e-3
        )
        assert float(loss_growth) == pytest.approx(
            errors_rad[task, law, "rtt272-loss50"] / errors_rad[task, law, "rtt272"], rel=5e-3
        )
