"""Plays a log on the network again: the same bytes with the same timing, under another session
name.
"""
