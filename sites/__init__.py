"""One operating-system process per manipulator: join, agree on the epoch, run the loop, leave."""
