"""Computes many simulations at once, each in one lane of the processor's vector registers.

The runs of a parameter sweep or a training environment often differ only in numerical values,
such as gains or delays. They can then share vector instructions: an instruction that multiplies
eight numbers computes the same product for eight runs. Each run gets bit-identical results to a
run computed alone.

Start reading at `run_groups`, which divides runs into groups that can be computed together.
"""
