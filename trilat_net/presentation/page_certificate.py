"""Renders the section of a report that explains whether the run was stable.

The section contains the sentences of `trilat certify`, and figures of V, the energy function in
the stability proof.

Invariant:
    - The sentences are those printed by `trilat certify`, but with longer names for the checks.
    - The figures are embedded as PNG data, because the page must be a single file.
"""

import base64
import io

from markupsafe import Markup
from matplotlib.figure import Figure

from ..analysis import Certificate, PushedTwins
from ..log import Log
from .certificate_text import describe_certificate, list_energies
from .figures.certificate_energy import draw_functional, draw_observed_energy
from .figures.twin_differences import draw_twins
from .html_templates import render_macro
from .page_html import (
    render_details,
    render_facts,
    render_folds,
    render_note,
    render_scrolling,
    render_section,
    render_table,
)
from .style import typeset

_PAGE_DPI = 110
_SENTENCE_MARKS = {"ok": "✓", "FAIL": "✗", "open": "?", "note": "·"}
_SENTENCE_CLASSES = {"ok": "passed", "FAIL": "failed", "open": "open", "note": "note"}
_LONG_NAMES = {
    "e and qd": "end (e: error, qd: joint speed)",
    "this rest": "roots of small motions about the final pose",
    "twins": "twins, runs with a small push",
    "log": "the log itself",
}
"""Mapping from the name of a check on a terminal to its name on the page."""
_SYMBOLS = (
    ("q, qd", "angle of a joint, in rad, and its speed, in rad/s"),
    (
        "q_des",
        "reference angle of a joint: mean of the other arms, weighted by the shares, in rad",
    ),
    ("e", "error of a joint, q − q_des"),
    (
        "α, share",
        "dominance factor: the weight of one arm in the mean that another arm follows",
    ),
    ("τ", "torque of the controller on a joint, in N m"),
    ("τ_x", "torque of hands and walls on a joint, with the sign of Eq. (8) of the paper"),
    ("θ, θ̂", "masses of an arm, and the controller's estimates of them"),
    ("V", "energy function of the paper's stability theorem, in J"),
    ("β", "weight of an arm in V"),
)
"""Symbols used on the page, with their meanings."""
_BALANCE_NOTE = (
    "V is the energy function of the stability theorem: a weighted sum of the energies of the "
    "arms, of their errors and of the estimates. The sum "
    "V − V(0) + dissipation − work must vanish, whatever the operators do."
)


def render_certificate(log: Log, certificate: Certificate) -> Markup:
    """Renders the section of the report that explains why a run was judged stable or not.

    The section contains the reasons as sentences, with collapsible tables and figures. The
    verdict itself is at the top of the page.

    Args:
        log: Log of the run.
        certificate: Stability certificate of the run.
    """
    _, *grounds = describe_certificate(certificate)
    lines = [
        {
            "mark": _SENTENCE_MARKS[line.mark],
            "css_class": _SENTENCE_CLASSES[line.mark],
            "text": typeset(_lengthen_name(line.text)),
        }
        for line in grounds
    ]
    body = render_macro("certificate.html", "grounds", lines=lines)
    folds = []

    if certificate.premises:
        premises = _render_premises(certificate)
        folds.append(
            render_details("What the theorem requires, and whether it holds here", premises)
        )

    if certificate.balance is not None:
        energies = list_energies(certificate.balance)
        rows = [(name, f"{energy_j:.4g}") for name, energy_j in energies]
        table = render_table({"energy": "", "J": "energy over the whole run"}, rows)
        note = render_note(_BALANCE_NOTE)
        folds.append(render_details("Energy balance", table + note))

    figures = _draw_certificate(log, certificate)
    if figures:
        pictures = Markup().join(_render_picture(title, figure) for title, figure in figures)
        names = ", ".join(title for title, _ in figures)
        folds.append(render_details(f"Figures: {names}", pictures))

    folds.append(render_details("Symbols on this page", render_facts(_SYMBOLS)))
    body += render_folds(folds)

    intro = (
        "✓ speaks for stability, ✗ against it, ? does not decide, · is a remark or does not "
        "apply (`trilat certify --all`)."
    )
    if certificate.has_functional:
        intro += " V: the energy function of the paper's theorem."
    return render_section("Why this judgement", intro, body, "certificate")


def _lengthen_name(sentence: str) -> str:
    """Replaces the short name at the start of a sentence with a name for readers of the page.

    Each sentence of `describe_certificate` starts with the name of a check and a colon. The
    short names are made for a terminal. Names that are not in `_LONG_NAMES`, and sentences
    without a colon, are left unchanged.
    """
    name, colon, rest = sentence.partition(": ")
    return f"{_LONG_NAMES.get(name, name)}{colon}{rest}"


def _render_premises(certificate: Certificate) -> Markup:
    """Renders the table of the premises of the stability theorem."""
    table = render_macro("certificate.html", "premises", premises=certificate.premises)
    return render_scrolling(table, "premises")


def _draw_certificate(log: Log, certificate: Certificate) -> list[tuple[str, Figure]]:
    """Draws the figures that show why a run was judged stable or not.

    There is one figure per kind of evidence: the energy function of the stability proof,
    energies recorded by the control laws themselves, and twins (repetitions of the run with a
    small push whose effect grows or decays).

    Returns:
        Title and figure of each.
    """
    observed = certificate.observed
    twins = certificate.twins
    figures = []
    if certificate.balance is not None:
        title = "V, the energy of the theorem, and its parts"
        figures.append((title, draw_functional(log, certificate)))
    if observed is not None and observed.curves:
        title = "energies that the laws declare"
        figures.append((title, draw_observed_energy(log, observed)))
    if twins is not None and twins.pushes:
        title = "growth or decay of small pushes"
        figures.append((title, draw_twins(PushedTwins(log, 0.0, twins))))
    return figures


def _render_picture(title: str, figure: Figure) -> Markup:
    """Renders a figure as an image with embedded PNG data."""
    drawing = io.BytesIO()
    figure.savefig(drawing, format="png", dpi=_PAGE_DPI)
    data = base64.b64encode(drawing.getvalue()).decode()
    source = f"data:image/png;base64,{data}"
    return render_macro("certificate.html", "picture", source=source, title=title)
