"""The arms: their dynamics, rotations, tasks, and the torques of operators and environments."""
