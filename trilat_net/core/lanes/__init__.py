"""Computes many simulations at once, each in one lane of the processor's vector registers.

The runs of a parameter sweep or of a training environment often differ in numbers only, such as
gains or delays. They can then share each vector instruction: an instruction that multiplies
eight numbers computes the same product for eight runs. Each run gets the same bits as if it
were computed alone.

Start at `run_groups`, which divides runs into groups that can be computed together.
"""
