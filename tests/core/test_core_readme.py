"""The README of the core has the tables and the list of files of the code."""

import re

import numpy as np
import pytest

from tests.core.core_readme import README, insert_tables, render_table
from trilat_net.core.links.link import link_dtype, sample_dtype
from trilat_net.core.plug.user_law import PeerView
from trilat_net.core.step.row_fields import FIELDS
from trilat_net.core.step.site_arrays import arrival_dtype, site_dtype
from trilat_net.core.step.site_setup import Layout
from trilat_net.core.step.ticks import LinkCounts

TEXT = README.read_text(encoding="utf-8")
CHAIN = Layout(joints=6, shared=3, parameters=60, chain=True, task=True)
STAGES = {
    "1 accept",
    "2 release",
    "3 reference",
    "4 errors",
    "5 estimate",
    "6 torque",
    "7 emit",
    "8 advance",
    "fused run",
    "setup",
    "input",
    "scratch",
}


@pytest.mark.parametrize("row", FIELDS)
def test_the_readme_shows_the_fields(row: str) -> None:
    assert render_table(row) in TEXT
    assert insert_tables(TEXT) == TEXT


def test_the_readme_names_every_file() -> None:
    listed = re.findall(r"^\| `(\w+\.py)` \| .+ \|$", TEXT, re.MULTILINE)
    files = {path.name for path in README.parent.glob("*/*.py") if path.stem != "__init__"}
    assert sorted(listed) == sorted(files)


def test_fields_have_a_unit_meaning_and_stage() -> None:
    for fields in FIELDS.values():
        for name, field in fields.items():
            assert field.meaning, name
            assert field.stage in STAGES, name
            assert "|" not in "".join(map(str, field[:4])), name


def test_layouts_have_the_fields_in_their_order() -> None:
    planar = [name for name, field in FIELDS["site"].items() if not field.chain_only]
    assert site_dtype(Layout()).names == tuple(planar)
    assert site_dtype(CHAIN).names == tuple(FIELDS["site"])
    assert link_dtype(3).names == tuple(FIELDS["link"])
    assert sample_dtype(3).names == tuple(FIELDS["sample"])
    assert arrival_dtype(3).names == tuple(FIELDS["arrival"])


def test_layouts_have_the_shapes_of_the_fields() -> None:
    site = np.zeros(1, site_dtype(CHAIN))
    assert site["J"].shape == (1, 3, 6)
    assert site["M"].shape == (1, 6, 6)
    assert site["theta_hat"].shape == (1, 60)
    assert site["mode"].dtype == np.int64
    assert site["wall_n"].dtype == np.float64
    assert link_dtype(3)["key"] == np.uint64


def test_links_have_the_fields_of_laws_and_counts() -> None:
    assert set(FIELDS["link"]) >= {*LinkCounts._fields, *PeerView._fields}
