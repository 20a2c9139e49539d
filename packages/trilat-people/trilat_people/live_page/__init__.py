"""Shows a running session on web pages, through which people can also take part.

`page_server` serves the pages, `terminal_watch` shows a session in a terminal instead, and
`experiment_sessions` conducts experiments, in which the same pages show several sessions one
after another.
"""
