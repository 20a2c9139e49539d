"""A certificate in sentences, for a terminal and for the page.

Law: the same words in both.
"""

import numpy as np

from .balance import NOTHING_J, Balance
from .certificate import Certificate


def sentences(found: Certificate) -> list[str]:
    """Returns the verdict, the balance, and the growth."""
    said = [f"certificate: {found.verdict.text}"]
    if found.balance is not None:
        said.append(f"energy balance: {balance_text(found.balance)}")
    return [*said, f"e and qd: {found.growth.text}"]


def balance_text(balance: Balance) -> str:
    """Returns how well the balance closes."""
    residual, rest = (float(np.abs(x).max()) for x in (balance.residual, balance.unexplained))
    scale = balance.scale
    if scale <= NOTHING_J:
        return "there is no energy in this run"
    text = f"off by at most {residual:.2g} J of {scale:.4g} ({residual / scale:.1e})"
    return f"{text}; {rest:.2g} J ({rest / scale:.1e}) once sampling is accounted for"
