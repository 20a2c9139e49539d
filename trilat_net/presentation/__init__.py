"""Presents the results of runs as figures, as a web page, as text and as files for other tools.

Invariant:
    - Matplotlib is imported only in this package and in the figures of `studies`, so that
      programs that draw nothing start fast.
"""
