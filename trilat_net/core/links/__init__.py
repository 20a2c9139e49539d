"""The network in the kernel: delays, losses, messages on their way, and who follows whom."""
