"""Measures whether small disturbances of a run grow or decay, by repeating the run.

A repetition of a run that receives a small push, for example at one joint, is called a twin.
The differences between the twin and the run show how the coupled arms react to a disturbance,
even if the run itself was never disturbed.
"""
