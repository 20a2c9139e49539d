"""A log in Rerun: what is shown where, and the viewer itself."""
