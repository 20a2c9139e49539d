"""Draws the figures of a run from its log, for papers and for the report.

Each figure is drawn by one function, registered under the name of the figure (`figure_entry`).
`registry` looks up the function by name and writes the figure to a file.
"""
