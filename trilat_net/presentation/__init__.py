"""Presents the results of runs as figures, web pages, text, and files for other tools.

The package `analysis` computes the results; this package draws and writes them. For example,
`page` writes the report of a run, and `certificate_text` composes the output of `trilat
certify`.

Invariant:
    - Matplotlib is imported only here and in the figures of `studies`, so programs that draw
      nothing start quickly.
"""

from typing import TYPE_CHECKING

from ..hooks import import_on_use, register_hooks

__all__ = [
    # Text
    "MARKS",
    "NEGATIVE_ENERGY_MEANING",
    "Block",
    "MarkedText",
    "TextTable",
    "compose_benchmark",
    "compose_citation",
    "compose_doctor",
    "compose_ping",
    "describe_energy_obstacle",
    "describe_judgement",
    "describe_moving_states",
    "err",
    "format_number",
    "print_error",
    "print_json",
    "print_line",
    "print_table",
    "terminal_output",
    # Figures
    "COLUMN_IN",
    "FIGURES",
    "FIGURE_FORMATS",
    "REPORT_DPI",
    "REPORT_SIZE",
    "SITE_COLOURS",
    "EpisodePicture",
    "FigureSize",
    "figure",
    "style",
    "write_figure",
    "write_figures",
    "write_overlay",
    # Reports, exports and viewers
    "Conclusion",
    "Exporter",
    "ViewerOptions",
    "conclude",
    "conclude_files",
    "list_export_formats",
    "open_rerun",
    "write_foxglove_layout",
]

if TYPE_CHECKING:
    from . import style, terminal_output
    from .appearance import COLUMN_IN, REPORT_SIZE, SITE_COLOURS, FigureSize
    from .certificate_text import describe_judgement
    from .citation import compose_citation
    from .conclusion import Conclusion, conclude, conclude_files
    from .episode_picture import EpisodePicture
    from .export import Exporter
    from .exports import list_export_formats
    from .figures.registry import FIGURES, figure, write_figures, write_overlay
    from .foxglove_layout import write_foxglove_layout
    from .linear_text import describe_moving_states
    from .network_text import compose_benchmark, compose_doctor, compose_ping
    from .observed_text import NEGATIVE_ENERGY_MEANING
    from .rerun_viewer import ViewerOptions, open_rerun
    from .result_text import MARKS, Block, MarkedText, TextTable, format_number
    from .style import FIGURE_FORMATS, REPORT_DPI, write_figure
    from .terminal_output import err, print_error, print_json, print_line, print_table
    from .verdict_text import describe_energy_obstacle
else:
    __getattr__ = import_on_use(
        __name__,
        {
            "appearance": "COLUMN_IN FigureSize REPORT_SIZE SITE_COLOURS",
            "certificate_text": "describe_judgement",
            "citation": "compose_citation",
            "conclusion": "Conclusion conclude conclude_files",
            "episode_picture": "EpisodePicture",
            "export": "Exporter",
            "exports": "list_export_formats",
            "figures.registry": "FIGURES figure write_figures write_overlay",
            "foxglove_layout": "write_foxglove_layout",
            "linear_text": "describe_moving_states",
            "network_text": "compose_benchmark compose_doctor compose_ping",
            "observed_text": "NEGATIVE_ENERGY_MEANING",
            "rerun_viewer": "ViewerOptions open_rerun",
            "result_text": "Block MARKS MarkedText TextTable format_number",
            "style": "FIGURE_FORMATS REPORT_DPI style write_figure",
            "terminal_output": (
                "err print_error print_json print_line print_table terminal_output"
            ),
            "verdict_text": "describe_energy_obstacle",
        },
    )

register_hooks(
    __name__,
    {
        "summarize a result": "result_text:summarize",
        "render a result as HTML": "result_text:render_html",
        "render a site's records as HTML": "site_html:render_site_html",
        "plot a log": "column_plot:plot_log",
        "head a certificate": "certificate_text:compose_headline",
        "describe a push": "twin_text:describe_push",
        "describe a finding": "finding_text:describe_finding",
        "describe what roots leave out": "decision_text:describe_left_out",
        "list the sentences of a finding": "finding_text:list_finding_sentences",
        "describe a premise": "verdict_text:describe_quantities",
        "name the theorem": "verdict_text:name_theorem",
    },
)
