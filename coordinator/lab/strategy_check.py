"""Check that the areas of a scenario can estimate under its strategy."""

from __future__ import annotations

from agents.strategies.installed import load_strategy
from dsse_core.errors import InvalidInputError
from dsse_core.estimation.plan import EstimationPlan
from scenarios.check import check_and_plan
from scenarios.scenario import Scenario


def check_with_strategy(scenario: Scenario) -> Scenario:
    """``scenario``, after a check of its meters: together they observe the grid.

    Where the strategy needs it, the meters of each area observe its part.

    Raises:
        InvalidInputError: as ``check_scenario``; or the strategy cannot be used.
    """
    plan_with_strategy(scenario)
    return scenario


def plan_with_strategy(scenario: Scenario) -> EstimationPlan | None:
    """Check as ``check_with_strategy``; the plan of the whole grid where the check made it (``check_and_plan``)."""
    strategy = load_strategy(scenario.strategy)
    if problems := strategy.find_area_problems(scenario.strategy, scenario.partition.areas):
        raise InvalidInputError(f"scenario {scenario.name!r}", problems)
    return check_and_plan(scenario, strategy.local_meters if strategy.estimates_alone else None)
