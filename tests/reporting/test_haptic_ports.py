from io import BytesIO

import numpy as np
import pytest

from tests.theory.analysed_ports import section_of
from trilat_net.reporting.appearance import REPORT_SIZE, FigureSize, make_print_size
from trilat_net.reporting.figures.linear_figures import draw_port_impedance, draw_port_passivity


@pytest.mark.long
@pytest.mark.parametrize(("name", "form"), [("two_sites", make_print_size(3.5)), ("p_d_margin", REPORT_SIZE)])
def test_figures_are_drawn_at_the_width_that_is_asked_for(name: str, form: FigureSize) -> None:
    for draw in (draw_port_impedance, draw_port_passivity):
        figure = draw(section_of(name), form)
        figure.savefig(BytesIO(), format="png", dpi=50)
        assert figure.get_size_inches()[0] == form.width_in


def test_impedance_has_free_and_clamped_line_for_each_hand() -> None:
    section = section_of("p_d_margin")
    size = draw_port_impedance(section).axes[0]
    assert len(size.lines) == 4
    drawn = np.asarray(size.lines[0].get_ydata())
    np.testing.assert_allclose(drawn, np.abs(section.transparency[0].free))


def test_where_a_criterion_fails_is_shaded() -> None:
    section = section_of("two_sites")
    above, below = draw_port_passivity(section).axes
    assert len(above.patches) == len(section.velocity.minima.below)
    assert len(below.patches) == sum(len(one.minima.below) for one in section.two_ports)
    above, below = draw_port_passivity(section_of("p_d_margin")).axes
    assert not above.patches
    assert not below.patches


def test_an_unstable_loop_has_figures_that_say_so() -> None:
    section = section_of("p_d_margin_two", (("control.d", 1.8),))
    for draw in (draw_port_impedance, draw_port_passivity):
        figure = draw(section)
        assert not figure.axes
        assert "unstable" in figure.texts[0].get_text()
