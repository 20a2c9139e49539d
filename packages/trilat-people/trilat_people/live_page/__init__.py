"""Shows a running session of several arms on web pages, on which people can also take part.

`page_server` is the server of the pages, `terminal_watch` shows a session in a terminal
instead, and `experiment_sessions` conducts experiments, in which several sessions are shown one
after the other on the same pages.
"""
