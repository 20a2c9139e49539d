"""Former places of names of the packages trilat-studies and trilat-people."""
