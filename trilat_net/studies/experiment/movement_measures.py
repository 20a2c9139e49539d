"""Names of `trilat_people.experiment.movement_measures`, which files of users import."""

from trilat_people.experiment.movement_measures import (
    PairMeasures,
    Throughput,
    energy_j,
    find_internal_force,
    measure_pair,
    measure_throughput,
    movement_time_s,
    path_length_m,
    raw_tlx,
    sparc,
    sus_score,
    weighted_tlx,
)

__all__ = [
    "PairMeasures",
    "Throughput",
    "energy_j",
    "find_internal_force",
    "measure_pair",
    "measure_throughput",
    "movement_time_s",
    "path_length_m",
    "raw_tlx",
    "sparc",
    "sus_score",
    "weighted_tlx",
]
