"""Virtual time: the same sites, joined by a simulated network, as fast as the machine can."""
