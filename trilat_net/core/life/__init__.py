"""Starts, aligns, limits and stops an arm, and lets humans or programs move the arm.

`session_life` decides when an arm waits, follows the others or stops. `resting` brings an arm
to rest, and `safeguards` limits its speed. `live_hand` computes how a human pulls an arm during
a run, and `own_hand` calls a user's program that pulls an arm.
"""
