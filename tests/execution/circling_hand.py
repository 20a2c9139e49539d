"""A hand that takes hold of an arm during a run, for runs in virtual time."""

import numpy as np

from trilat_net.core.life.live_hand import HandCommand
from trilat_net.core.step.site_step import Site
from trilat_net.scenario import Scenario


class CirclingHand:
    """Holds an arm from 0.2 s to 0.7 s and leads it, 60 messages a second; then the hand is silent."""

    def __init__(self, scenario: Scenario, site: str) -> None:
        self._arm = scenario.arms[site]
        spec = scenario.sites[site]
        live = spec.find_live_hand()
        assert live is not None
        self._mode = live.mode
        self._rules = live.make_rules(spec.rate_hz, self._arm)
        self._memory = self._rules.start().memory

    def __call__(self, site: Site, k: int) -> list[float]:
        def place() -> list[float]:
            return site.q if self._mode == "joint" else self._arm.end_effector(site.q)

        commands = []
        if 200 <= k <= 700 and k % 17 == 0:
            goal = (
                [0.4 * np.sin(0.01 * (k - 200)), 0.3] if self._mode != "force" else [5.0, 5.0]
            )
            start = (0.0, 0.0) if self._mode == "force" else place()
            target = tuple(float(a + b) for a, b in zip(start, goal, strict=True))
            commands = [HandCommand(7, k, True, target, k * 1_000_000)]
        step = self._rules.advance(self._memory, k * 1_000_000, commands, place)
        self._memory = step.memory
        return step.vector
