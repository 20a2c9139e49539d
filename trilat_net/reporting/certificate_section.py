"""HTML section of a stability certificate in the report page: verdict, premises, energies and figure.

Invariant: every text from a log is escaped.
"""

from html import escape

from ..analysis.certificate.stability_certificate import Certificate, certificate_to_json, certify
from ..log.log_reader import Log
from .certificate_text import describe_certificate, list_energies
from .figures.certificate_energy import draw_functional
from .page import ReportSection

KEY = "certificate"
HEADING = "Was it stable, and why"
_MARKS = {True: "holds", False: '<span style="color:var(--bad)">fails</span>', None: "not told"}
_NOTE = (
    "V of the theorem, with the weights that the shares ask for, and its energy balance: what is left of "
    "V − V(0) + dissipation − work must vanish, whatever the hands do."
)


def build_certificate_section(log: Log) -> ReportSection:
    """Returns the certificate of a log as a section of its report.

    Raises:
        LogError: a record cannot be read, or names a change that is none.
    """
    found = certify(log)
    rows = "".join(
        f"<tr><th>{escape(p.name)}</th><th>{_MARKS[p.holds]}</th><td>{escape(p.text)}</td></tr>"
        for p in found.premises
    )
    first, *others = (escape(line.text) for line in describe_certificate(found))
    said = f"<p><strong>{first}</strong></p>" + "".join(f"<p>{text}</p>" for text in others)
    html = f'{said}<div class="scroll"><table class="facts">{rows}</table></div>{_energies(found)}'
    return ReportSection(KEY, HEADING, html, certificate_to_json(found), draw_functional(log, found))


def _energies(found: Certificate) -> str:
    """Returns the table of energies; "" without a functional."""
    if found.balance is None:
        return ""
    rows = "".join(
        f"<tr><td>{escape(name)}</td><td>{value:.4g}</td></tr>"
        for name, value in list_energies(found.balance)
    )
    head = "<thead><tr><th>energy</th><th>J</th></tr></thead>"
    table = f'<div class="scroll"><table class="sites">{head}<tbody>{rows}</tbody></table></div>'
    return f'{table}<p class="note">{escape(_NOTE)}</p>'
