"""What people do at arms: the live page, devices that a person holds, and experiments."""
