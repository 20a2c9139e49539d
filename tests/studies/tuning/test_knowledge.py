import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trilat_net.errors import UsageError
from trilat_net.studies.tuning.search_space import GRAVITY_PARAMETERS, build_model_information

from .experiments import trio

SHARES = st.floats(50.0, 150.0)


@given(percent=SHARES)
def test_the_box_holds_the_truth_strictly_inside(percent: float) -> None:
    """Otherwise V' <= 0 does not stand, and a law would be searched where it cannot work."""
    scenario, knowledge = trio(), build_model_information(percent)
    truth = scenario.sites["s"].arm.theta
    low, high = knowledge.box_sides(scenario, "s")
    assert (np.array(low) < truth).all()
    assert (np.array(high) > truth).all()


@given(percent=SHARES)
def test_all_are_told_one_share_of_gravity_and_nothing_of_inertia(percent: float) -> None:
    scenario = trio()
    prior = np.array(build_model_information(percent).prior(scenario, "m1"))
    truth = np.array([2.0, 1.0])  # (m1 lc1 + m2 l1, m2 lc2) of point masses at the ends, Eq. (24)
    assert (prior[: GRAVITY_PARAMETERS.start] == 0.0).all()
    assert prior[GRAVITY_PARAMETERS] == pytest.approx(truth * percent / 100.0)


@pytest.mark.parametrize("percent", [0.0, 49.0, 151.0, float("nan"), float("inf")])
def test_what_nobody_could_be_told_is_refused(percent: float) -> None:
    with pytest.raises(UsageError, match="--gravity is from 50 to 150 %"):
        build_model_information(percent)
