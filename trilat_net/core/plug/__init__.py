"""Control laws that are plugged into the kernel: those of users, compiled or in Python."""
