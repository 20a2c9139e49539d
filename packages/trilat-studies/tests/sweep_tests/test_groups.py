"""Cells whose runs differ in more than numbers form groups that run one after the other."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from trilat_studies.sweep.cell_groups import CellGroups
from trilat_studies.sweep.sweep_plan import plan_sweep


@given(st.lists(st.integers(1, 4), min_size=1, max_size=4), st.data())
def test_every_cell_is_in_one_group(sizes: list[int], data: st.DataObject) -> None:
    """Groups in any partition of the axes contain each cell once."""
    parts = []
    for size in sizes:
        labels = data.draw(st.lists(st.integers(0, 2), min_size=size, max_size=size))
        indices_of: dict[int, list[int]] = {}
        for index, label in enumerate(labels):
            indices_of.setdefault(label, []).append(index)
        parts.append(tuple(map(tuple, indices_of.values())))

    groups = CellGroups(("key",), tuple(parts))
    cells = list(groups.iterate_cells(sizes))

    total = 1
    for size in sizes:
        total *= size
    assert sorted(cells) == list(range(total))


@pytest.mark.parametrize(
    ("over", "laws", "groups", "keys"),
    [
        (["control.Kd=2:3:0.5", "link.delay_ms=20,40"], [], 1, ()),
        (["control.Kd=2:3:0.5", "sites.s.rate_hz=1000,500"], [], 2, ("sites.s.rate_hz",)),
        (["link.delay_ms=20,40"], ["p_d", "pd_d", "adaptive"], 2, ("law",)),
        (["control.Kd=2,3", 'sites.s.on_stale={action="use"},{action="hold"}'], [], 2, None),
    ],
)
def test_axes_that_change_structure_split_cells(
    over: list[str], laws: list[str], groups: int, keys: tuple[str, ...] | None
) -> None:
    cell_groups = CellGroups.of_plan(plan_sweep("free", over=over, laws=laws))
    assert cell_groups.group_count == groups
    assert keys is None or cell_groups.keys == keys
    assert bool(cell_groups.sentence) == (groups > 1)
    assert all(key in cell_groups.sentence for key in cell_groups.keys)


def test_cells_of_one_structure_run_together() -> None:
    """The axis that changes the structure is the last one, which varies fastest in the grid."""
    plan = plan_sweep("free", over=["control.Kd=2:4:1", "sites.s.rate_hz=1000,500"])
    cells = list(CellGroups.of_plan(plan).iterate_cells(plan.shape))
    rates_hz = [plan.cell(number).values[1] for number in cells]
    assert rates_hz == [1000.0] * 3 + [500.0] * 3
