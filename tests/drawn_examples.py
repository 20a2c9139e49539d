"""Hypothesis profiles of all tests, with no limit of time, which a busy machine would exceed.

Importing this module loads the profile. Each `conftest.py` does so, because a package's tests may
run alone.
"""

import os

from hypothesis import HealthCheck, settings

settings.register_profile("desk", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("ci", settings.get_profile("desk"), derandomize=True, print_blob=True)
settings.register_profile("push", settings.get_profile("ci"), max_examples=10)
settings.load_profile("ci" if os.environ.get("CI") else "desk")
