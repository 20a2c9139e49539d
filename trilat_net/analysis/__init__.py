"""Figures, numbers and the page of a log. Only this package imports matplotlib; only a report imports it."""
