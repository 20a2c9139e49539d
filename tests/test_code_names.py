"""Names in backticks in docstrings and pages exist: modules, classes, functions, keys, options, tests."""

import re

import pytest

from .code_names import Reference, is_defined, iterate_references

FOREIGN = frozenset({
    "CompileResult._reduce", "ZBytes", "__del__", "activate", "fping", "jupytext", "rmw_zenoh", "scipy.signal.csd", "pwr.t.test",
    "to_parquet", "observation.environment_state",
})  # fmt: skip
"""Names of Python and of other people's programs."""

PUBLISHED = frozenset({"core.tick.Output", "core.tick.Mode"})
"""Names in the texts of schemas that are part of logs: these texts stay as they were published."""

PARTS_OF_NAMES = frozenset({"_hz", "is_", "has_", "can_", "find_"})
"""Beginnings and ends of names."""

EXAMPLES = frozenset({"received_wave", "scenario.toml.damaged"})
"""Names that are examples."""

SYMBOLS = re.compile(r"(?:[A-Za-z]|ed|qd|x|th|Kd)_(?:[ijk]{1,2}d?|hat)|T_ij|theta_\d(?:_hat)?")
"""Symbols of the paper with their indices."""

COMPOSED = re.compile(
    r"\w+_q[wxyz]|\w+_[xyz]_m|ch_\w+_nm|sent_(?:E|u_to_m2)|peer_tau_x"  # columns of exports and observations
    r"|(?:m1|m2|s)[._]\w+(?:\.\w+)*"  # variables of MATLAB files, of a site
    r"|qN_rad|push(?:N|_elbow)_mean_nm"  # metrics of a joint
    r"|gravity[1n]"  # states of a linear loop
    r"|undelayed_rms_rad"  # a quantity with its unit
    r"|rms_error_rad_(?:mean|half)"  # columns of a sweep with seeds
    r"|did_not_rise|not_judged"  # verdicts, by their texts
    r"|\.\.\._max_\.\.\."
)
"""Names that the program composes of others."""


def test_every_name_in_backticks_is_defined() -> None:
    stale = [
        f"{reference.file}:{reference.line}: {reference.name}"
        for reference in iterate_references()
        if reference.name not in FOREIGN | PUBLISHED | PARTS_OF_NAMES | EXAMPLES
        and not SYMBOLS.fullmatch(reference.name)
        and not COMPOSED.fullmatch(reference.name)
        and not is_defined(reference.name)
    ]
    assert not stale, "\n".join(["names in backticks that nothing defines:", *stale])


@pytest.mark.parametrize(
    "name",
    [
        "session_api",
        "core.tick.Output",
        "order_conditions",
        "site_step.Sight",
        "test_of_nothing_...",
    ],
)
def test_an_undefined_name_is_found(name: str) -> None:
    names = [Reference("page.md", 1, part) for part in name.split()]
    assert not any(is_defined(reference.name) for reference in names)


def test_names_of_each_kind_are_defined() -> None:
    names = (
        "site_step",
        "Site.step",
        "core.link.accept_sample",
        "simulate()",
        "link.delay_ms",
        "qd_limit_rad_s",
    )
    assert all(map(is_defined, names))
