"""The plan of a sweep: the values of one key of a scenario, and for each value strategies and seeds."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any

import numpy as np

from agents.strategies.installed import list_strategies
from coordinator.lab.evaluation.answers import version_of
from coordinator.lab.evaluation.evaluation import NO_CHANGES, NO_SETTINGS, choose_scenario
from dsse_core.errors import InvalidInputError
from scenarios.faults.faults import LinkChanges
from scenarios.files.key_values import parse_values
from scenarios.scenario import Scenario, load_scenario

NUMBER = r"[-+]?[0-9.]+(?:[eE][-+]?[0-9]+)?"
MAX_VALUES = 10_000
OPTION_OF_KEY = {"seed": "--seeds", "strategy": "--strategies"}


@dataclass(frozen=True)
class Task:
    """A run of a sweep. ``value``: of the varied key, as the table writes it."""

    value: str
    strategy: str
    seed: int


@dataclass(frozen=True)
class SweepPlan:
    """The plan of a sweep.

    ``scenarios``: value as the table writes it -> the scenario with that value of ``key``. ``seeds``: their number.
    """

    key: str
    base: Scenario
    scenarios: Mapping[str, Scenario]
    strategies: tuple[str, ...]
    seeds: int
    links: LinkChanges

    @property
    def tasks(self) -> list[Task]:
        """All runs. The seeds count up from that of the scenario; the values vary fastest."""
        seeds = range(self.base.seed, self.base.seed + self.seeds)
        return [Task(value, name, seed) for seed in seeds for name in self.strategies for value in self.scenarios]

    def scenario_of(self, task: Task) -> Scenario:
        return replace(self.scenarios[task.value], strategy=task.strategy, seed=task.seed)

    @property
    def settings(self) -> dict[str, Any]:
        """Settings common to all rows of one table. Values, strategies and seeds may be added later."""
        return {
            "scenario": self.base.name,
            "links": dict(self.links),
            "scenario_sha256": hash_scenario(self.base),
            "vary": self.key,
            "version": version_of("consensus-dsse"),
        }


def hash_scenario(scenario: Scenario) -> str:
    """SHA-256 of the content of ``scenario``, its network included; the path of its file does not matter."""
    content = repr([_content(getattr(scenario, f.name)) for f in fields(scenario) if f.name != "path"])
    return hashlib.sha256(content.encode()).hexdigest()


def _content(value: object) -> object:
    """``value`` with its whole content, which its own repr may shorten; fields derived from others are left out."""
    if is_dataclass(value):
        return [(f.name, _content(getattr(value, f.name))) for f in fields(value) if f.init]
    if isinstance(value, Mapping):
        return [(_content(key), _content(of_key)) for key, of_key in value.items()]
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_content(item) for item in value]
    return value


def make_plan(
    name_or_path: str,
    key: str,
    values: Sequence[object],
    strategies: Sequence[str],
    seeds: int,
    links: LinkChanges = NO_CHANGES,
    timeout_s: float | None = None,
    changes: Mapping[str, object] = NO_SETTINGS,
) -> SweepPlan:
    """Reads the scenario once for each of ``values`` of ``key``. ``changes``: key -> value in all runs.

    Raises:
        InvalidInputError: the scenario cannot be used, ``key`` has an option of its own or is also in ``changes``, a
            value is given twice, or the scenario rejects values; then it names them all, with the reasons.
    """
    if key in OPTION_OF_KEY:
        raise _vary_error(f"{key} is varied by {OPTION_OF_KEY[key]}; choose another key")
    texts = [text_of(value) for value in values]
    if twice := [text for text in dict.fromkeys(texts) if texts.count(text) > 1]:
        raise _vary_error(f"{key}: {', '.join(twice)} is given twice; keep one")
    if key in changes:
        raise _vary_error(f"{key} cannot be varied and set; give one of --vary and --set")
    base = choose_scenario(name_or_path, timeout_s=timeout_s, links=links, changes=changes)
    scenarios, problems = {}, []
    for value in values:
        try:
            loaded = load_scenario(name_or_path, strategies=list_strategies(), changes={**changes, key: value})
            scenarios[text_of(value)] = choose_scenario(loaded, timeout_s=timeout_s, links=links)
        except InvalidInputError as error:
            problems += [f"with {key} = {text_of(value)}: {problem}" for problem in error.problems]
    if problems:
        raise InvalidInputError(str(base.path), list(dict.fromkeys(problems)))
    return SweepPlan(key, base, scenarios, tuple(strategies), seeds, links)


def parse_vary(vary: str) -> tuple[str, list[object]]:
    """The key and the values of ``KEY=START:STOP:N`` or ``KEY=VALUE,VALUE,...``, values as TOML writes them.

    Raises:
        InvalidInputError: ``vary`` has neither form.
    """
    key, equals, text = (part.strip() for part in vary.partition("="))
    if not (key and equals and text):
        raise _vary_error(f"{vary!r} must be KEY=START:STOP:N or KEY=VALUE,VALUE,..., e.g. faults.loss=0:0.9:10")
    values = _parse_range(text) if re.fullmatch(f"{NUMBER}:{NUMBER}(:.*)?", text) else parse_values(text)
    return key, values


def text_of(value: object) -> str:
    """``value`` as the table of a sweep writes it."""
    return value if isinstance(value, str) else json.dumps(value)


def _parse_range(text: str) -> list[object]:
    start, stop, count = (*text.split(":", 2), "")[:3]
    try:
        first, last, n = float(start), float(stop), int(count)
    except ValueError:
        n = 0
    if not 2 <= n <= MAX_VALUES:
        raise _vary_error(f"{text!r} must be START:STOP:N with two numbers and N, 2 to {MAX_VALUES} values")
    points = [float(f"{point:.12g}") for point in np.linspace(first, last, n)]  # 0.3, not 0.30000000000000004
    whole = all(re.fullmatch(r"[-+]?\d+", end) for end in (start, stop)) and all(p.is_integer() for p in points)
    return [int(point) if whole else point for point in points]


def _vary_error(problem: str) -> InvalidInputError:
    return InvalidInputError("--vary", [problem])
