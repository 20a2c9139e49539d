"""Draws the figures of a log, the file with the results of a run.

Each figure is drawn by one function, which is registered under the name of the figure
(`figure_entry`). `registry` finds the function of a name and writes the figure to a file.
"""
