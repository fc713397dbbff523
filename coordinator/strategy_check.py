"""Can the areas of a scenario estimate under its strategy?"""

from __future__ import annotations

from agents.strategies.installed import load_strategy
from dsse_core.errors import InvalidInputError
from dsse_core.estimation.plan import EstimationPlan
from scenarios.check import check_and_plan
from scenarios.scenario import Scenario


def check_with_strategy(scenario: Scenario) -> Scenario:
    """``scenario``, whose meters observe the grid together and, where its strategy needs it, each area's own its part.

    Raises:
        InvalidInputError: as ``check_scenario``; or the strategy cannot be used.
    """
    plan_with_strategy(scenario)
    return scenario


def plan_with_strategy(scenario: Scenario) -> EstimationPlan | None:
    """As ``check_with_strategy``; the plan of the whole grid, where the check has made it (``check_and_plan``)."""
    strategy = load_strategy(scenario.strategy)
    if problems := strategy.find_ring_problems(scenario.strategy, scenario.partition.areas):
        raise InvalidInputError(f"scenario {scenario.name!r}", problems)
    return check_and_plan(scenario, strategy.local_meters if strategy.estimates_alone else None)
