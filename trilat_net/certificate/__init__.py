"""Was it stable, and why: the paper's functional along a log, its energy balance, the theorem's premises."""
