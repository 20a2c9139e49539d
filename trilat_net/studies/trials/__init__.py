"""Trials: a scenario run once per seed and checked against its [expect].

From pytest, one test per seed:

    import pytest
    import trilat_net

    TRIALS = trilat_net.trials("jitter", seeds=range(1, 6))

    @pytest.mark.parametrize("trial", TRIALS, ids=str)
    def test_jitter(trial):
        trial.check()

Or all seeds in one, on all cores: `trilat_net.check("jitter", seeds=range(1, 21))`.
"""
