"""Starts, aligns, limits and stops an arm, and lets people or programs move it.

`session_life` decides when an arm waits, follows the others or stops. `resting` brings an arm
to rest, and `safeguards` limits its speed. `live_hand` computes how a person pulls an arm
during a run, and `own_hand` runs a user's program that pulls an arm.
"""
