"""Shows a running session to people on a web page, from which they can also take part.

A session is a run in which several processes ("sites") each control one robot arm. The package
contains the server of the page, the display in a terminal, and experiments with people, in
which one session after the other is shown on the same pages.
"""
