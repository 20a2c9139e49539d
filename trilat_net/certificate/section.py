"""What the report shows of a certificate.

Law: every text that came with a log is escaped.
"""

from html import escape

from ..analysis.section import Section
from ..log.reader import Log
from .certificate import certify
from .facts import facts
from .figure import functional_over_time
from .words import sentences

KEY = "certificate"
HEADING = "Was it stable, and why"
_MARKS = {True: "holds", False: "fails", None: "not told"}
_NOTE = (
    "V of the theorem, with the weights that the shares ask for, and its energy balance: what is left of "
    "V − V(0) + dissipation − work must vanish, whatever the hands do."
)


def section(log: Log) -> Section:
    """Returns the certificate of a log as a section of its report.

    Raises:
        LogError: a record cannot be read, or names a change that is none.
    """
    found = certify(log)
    rows = "".join(
        f"<tr><th>{escape(p.name)}</th><td>{_MARKS[p.holds]}</td><td>{escape(p.text)}</td></tr>"
        for p in found.premises
    )
    said = "".join(f"<p>{escape(line)}</p>" for line in sentences(found))
    html = f'{said}<div class="scroll"><table>{rows}</table></div><p class="note">{escape(_NOTE)}</p>'
    return Section(KEY, HEADING, html, facts(found), functional_over_time(log, found))
