import json
from io import BytesIO

import numpy as np
import pytest

from tests.theory.analysed_ports import section_of
from trilat_net.presentation.appearance import REPORT_SIZE, FigureSize
from trilat_net.presentation.figures.linear_figures import (
    draw_port_impedance,
    draw_port_passivity,
)
from trilat_net.presentation.linear_text import describe_ports


def test_passive_ports_get_a_word_each() -> None:
    lines = describe_ports(section_of("p_d_margin_two"))
    assert lines[0].startswith("Ports of m, s, operators and environments off, 0.001-100 Hz")
    assert "evidence, no proof" in lines[0]
    assert "  operators passive in qd, coupled or not: passive" in lines
    assert "    Llewellyn, every pair and joint: holds (2 two-ports)" in lines
    assert not any(" r = " in line for line in lines)
    assert sum("the ratio is" in line for line in lines) == 2


def test_active_ports_have_frequency_and_amount() -> None:
    section = section_of("two_sites")
    text = "\n".join(describe_ports(section))
    (span,) = section.velocity.minima.below
    assert f"not passive at 0.001-{span.to_hz:.3g} Hz" in text
    assert f"least eigenvalue {section.velocity.minima.least:.3g} at" in text
    assert "no damping at the joints would make it passive" in text
    assert "the proof's premise: passive; sites weighted 1, 1" in text
    assert "some make it unstable at" in text


def test_unstable_loops_get_no_further_words() -> None:
    lines = describe_ports(section_of("p_d_margin_two", (("control.d", 1.8),)))
    assert len(lines) == 2
    assert "the loop without operators is unstable" in lines[1]


def test_destabilising_clamps_leave_nothing_to_feel() -> None:
    lines = describe_ports(
        section_of("contact", (("sites.m.hands", ()), ("sites.s.environment", ())))
    )
    assert lines[-1] == "  with s clamped the loop is unstable: it has no steady impedance"
    assert any("ranges more" in line for line in lines)


def test_facts_have_the_numbers_of_the_lines() -> None:
    for name in ("p_d_margin_two", "two_sites"):
        section = section_of(name)
        facts = json.loads(json.dumps(section.to_json(), allow_nan=False))
        assert facts["passive_qd"]["holds"] is section.velocity.passive
        assert facts["passive_qd"]["least"] == section.velocity.minima.least
        assert facts["felt"][0]["ratio_db"] == section.transparency[0].ratio_db
        assert (
            facts["felt"][0]["difference_nm_s_rad"]
            == section.transparency[0].difference_nm_s_rad
        )
        assert (facts["passive_r"] is None) is (section.proof is None)
    assert facts["passive_qd"]["lacking_nm_s_rad"] is None


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "form"), [("two_sites", FigureSize.for_print(3.5)), ("p_d_margin", REPORT_SIZE)]
)
def test_figures_have_the_requested_width(name: str, form: FigureSize) -> None:
    for draw in (draw_port_impedance, draw_port_passivity):
        figure = draw(section_of(name), form)
        figure.savefig(BytesIO(), format="png", dpi=50)
        assert figure.get_size_inches()[0] == form.width_in


def test_impedance_has_lines_for_each_hand() -> None:
    section = section_of("p_d_margin")
    size = draw_port_impedance(section).axes[0]
    assert len(size.lines) == 4
    drawn = np.asarray(size.lines[0].get_ydata())
    np.testing.assert_allclose(drawn, np.abs(section.transparency[0].free))


def test_failing_criteria_are_shaded() -> None:
    section = section_of("two_sites")
    above, below = draw_port_passivity(section).axes
    assert len(above.patches) == len(section.velocity.minima.below)
    assert len(below.patches) == sum(
        len(two_port.minima.below) for two_port in section.two_ports
    )
    above, below = draw_port_passivity(section_of("p_d_margin")).axes
    assert not above.patches
    assert not below.patches


def test_figures_of_unstable_loops_say_so() -> None:
    section = section_of("p_d_margin_two", (("control.d", 1.8),))
    for draw in (draw_port_impedance, draw_port_passivity):
        figure = draw(section)
        assert not figure.axes
        assert "unstable" in figure.texts[0].get_text()
