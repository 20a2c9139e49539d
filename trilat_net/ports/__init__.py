"""What hands feel at their sites, and whether the teleoperator is passive there: a loop as a multiport."""
