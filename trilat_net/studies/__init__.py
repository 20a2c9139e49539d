"""Studies of many runs: trials against expectations, sweeps over a plane of keys, and tuning of
control laws.

Invariant: a study is a function of its plan; the number of worker processes and the order in
which they finish enter no result.
"""
