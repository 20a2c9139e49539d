"""Presents the results of runs as figures, as a web page, as text and as files for other tools.

Invariant:
    - Matplotlib is imported only in this package and in the figures of `studies`, so that
      programs that draw nothing start fast.
"""

from ..hooks import register_hooks

register_hooks(
    __name__,
    {
        "summarize a result": "result_text:summarize",
        "render a result as HTML": "result_text:render_html",
        "render a site's records as HTML": "site_html:render_site_html",
        "plot a log": "column_plot:plot_log",
        "head a certificate": "certificate_text:compose_headline",
        "describe a premise": "premise_text:describe_quantities",
        "describe missing functionals": "premise_text:describe_missing_functionals",
        "describe closed groups": "premise_text:describe_closed_groups",
        "describe a verdict": "verdict_text:describe_verdict",
        "describe a growth of V": "verdict_text:describe_growth",
        "describe evidence": "verdict_text:describe_evidence",
        "doubt evidence": "verdict_text:doubt_evidence",
        "name the theorem": "verdict_text:name_theorem",
    },
)
