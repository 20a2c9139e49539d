"""The modes of a site from its start to its end, its safeguards, and hands that move it."""
