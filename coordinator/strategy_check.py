"""Can the areas of a scenario estimate under its strategy?"""

from __future__ import annotations

from agents.strategies.installed import load_strategy
from scenarios.check import check_scenario
from scenarios.scenario import Scenario


def check_with_strategy(scenario: Scenario) -> Scenario:
    """``scenario``, whose meters observe the grid together and, where its strategy needs it, each area's own its part.

    Raises:
        InvalidInputError: as ``check_scenario``; or the strategy cannot be used.
    """
    strategy = load_strategy(scenario.strategy)
    return check_scenario(scenario, strategy.local_meters if strategy.estimates_alone else None)
