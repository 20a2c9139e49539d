"""Measures the speed, latency and memory of this program on this machine.

Where possible, the results are ratios of two measurements of the same run.

python -m benchmarks            all of them
python -m benchmarks tick virtual   only these
"""
