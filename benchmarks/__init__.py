"""Figures of this program on this machine, as ratios within one run where ratios are what matters.

python -m benchmarks            all of them
python -m benchmarks tick sim   some
"""
