"""Experiments with people: movement measures, questionnaires, and the statistics of what they
show.
"""
