"""Machine code of the cache: what one process has compiled another may load, beside that of a third."""

from tests.core.compiled import printed

SYMBOLS = """
import numba, numpy as np
from numba.core.itanium_mangler import mangle
from trilat_net.core.site_arrays import site_dtype
from trilat_net.core.site_setup import Layout
for n in {}:
    site = numba.typeof(np.zeros(1, site_dtype(Layout(n, n, 10 * n, True))))
    print(n, mangle("leaf", [site, site.dtype]))
"""


def test_symbols_of_leaves_tell_layouts_apart_whatever_a_process_has_met_before() -> None:
    """As Numba numbers them, the first layout of any process has the symbols of any other's."""
    one, other = (
        dict(line.split() for line in printed(SYMBOLS.format(order), compiled=True).splitlines())
        for order in ((6, 7), (7, 6))
    )
    assert one == other
    assert one["6"] != one["7"]
