"""The plan of a sweep: values of keys of a scenario, and for each combination of values strategies and seeds."""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any

import numpy as np

from agents.strategies.installed import list_strategies
from coordinator.lab.evaluation.answers import version_of
from coordinator.lab.evaluation.evaluation import NO_CHANGES, NO_SETTINGS, choose_scenario
from dsse_core.errors import InvalidInputError
from scenarios.faults.faults import LinkChanges
from scenarios.files.key_values import parse_value, parse_values
from scenarios.scenario import Scenario, load_scenario

NUMBER = r"[-+]?[0-9.]+(?:[eE][-+]?[0-9]+)?"
MAX_VALUES = 10_000
OUTSIDE_QUOTES = r'(?=(?:[^"]*"[^"]*")*[^"]*$)'
OPTION_OF_KEY = {"seed": "--seeds", "strategy": "--strategies"}


@dataclass(frozen=True)
class Axis:
    """Keys that take the same value, and their values."""

    keys: tuple[str, ...]
    values: Sequence[object]


@dataclass(frozen=True)
class Task:
    """A run of a sweep. ``values``: one for each axis, as the table writes them."""

    values: tuple[str, ...]
    strategy: str
    seed: int


@dataclass(frozen=True)
class SweepPlan:
    """The plan of a sweep.

    ``keys``: of each axis. ``scenarios``: values of the axes, as the table writes them -> the scenario with them.
    ``seeds``: their number.
    """

    keys: tuple[tuple[str, ...], ...]
    base: Scenario
    scenarios: Mapping[tuple[str, ...], Scenario]
    strategies: tuple[str, ...]
    seeds: int
    links: LinkChanges

    @property
    def tasks(self) -> list[Task]:
        """All runs. The seeds count up from that of the scenario; the values vary fastest."""
        seeds = range(self.base.seed, self.base.seed + self.seeds)
        return [Task(values, name, seed) for seed in seeds for name in self.strategies for values in self.scenarios]

    def scenario_of(self, task: Task) -> Scenario:
        return replace(self.scenarios[task.values], strategy=task.strategy, seed=task.seed)

    @property
    def settings(self) -> dict[str, Any]:
        """Settings common to all rows of one table. Values, strategies and seeds may be added later."""
        return {
            "scenario": self.base.name,
            "links": dict(self.links),
            "scenario_sha256": hash_scenario(self.base),
            "vary": [list(keys) for keys in self.keys],
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
    axes: Sequence[Axis],
    strategies: Sequence[str],
    seeds: int,
    links: LinkChanges = NO_CHANGES,
    timeout_s: float | None = None,
    changes: Mapping[str, object] = NO_SETTINGS,
) -> SweepPlan:
    """Reads the scenario once for each combination of the values of ``axes``. ``changes``: key -> value in all runs.

    Raises:
        InvalidInputError: the scenario cannot be used, a key has an option of its own or is also in ``changes``, a key
            or a value is given twice, or the scenario rejects values; then it names them all, with the reasons.
    """
    _check_axes(axes, changes, links, seeds)
    base = choose_scenario(name_or_path, timeout_s=timeout_s, links=links, changes=changes)
    scenarios, problems = {}, []
    for values in itertools.product(*(axis.values for axis in axes)):
        varied = {key: value for axis, value in zip(axes, values, strict=True) for key in axis.keys}
        texts = tuple(map(text_of, values))
        try:
            loaded = load_scenario(name_or_path, strategies=list_strategies(), changes={**changes, **varied})
            scenarios[texts] = choose_scenario(loaded, timeout_s=timeout_s, links=links)
        except InvalidInputError as error:
            with_values = " and ".join(
                f"{','.join(axis.keys)} = {text}" for axis, text in zip(axes, texts, strict=True)
            )
            problems += [f"with {with_values}: {problem}" for problem in error.problems]
    if problems:
        raise InvalidInputError(str(base.path), list(dict.fromkeys(problems)))
    return SweepPlan(tuple(axis.keys for axis in axes), base, scenarios, tuple(strategies), seeds, links)


def _check_axes(axes: Sequence[Axis], changes: Mapping[str, object], links: LinkChanges, seeds: int) -> None:
    keys = [key for axis in axes for key in axis.keys]
    problems = [
        f"{key} is varied by {option}; choose another key" for key, option in OPTION_OF_KEY.items() if key in keys
    ]
    problems += [f"{key} is varied twice; keep one" for key in dict.fromkeys(keys) if keys.count(key) > 1]
    problems += [f"{key} cannot be varied and set; give one of --vary and --set" for key in keys if key in changes]
    fixed = {f"faults.{re.sub('_s$', '_ms', key)}" for key in links}
    problems += [f"{key} cannot be varied beside the option that sets it for all links" for key in keys if key in fixed]
    for axis in axes:
        texts = list(map(text_of, axis.values))
        twice = [text for text in dict.fromkeys(texts) if texts.count(text) > 1]
        problems += [f"{','.join(axis.keys)}: {', '.join(twice)} is given twice; keep one"] if twice else []
    problems += [f"{','.join(axis.keys)} has no value; give at least one" for axis in axes if not axis.values]
    if (n := math.prod(len(axis.values) for axis in axes)) > MAX_VALUES:
        problems.append(f"{n} combinations of values; the limit is {MAX_VALUES}")
    if seeds < 1:
        problems.append(f"{seeds} seeds; give at least one")
    if problems:
        raise InvalidInputError("--vary", problems)


def parse_vary(vary: str) -> Axis:
    """The axis of ``KEY[,KEY...]=START:STOP:N`` or ``KEY[,KEY...]=VALUE,VALUE,...``, values as TOML writes them.

    Raises:
        InvalidInputError: ``vary`` has neither form.
    """
    keys, equals, text = (part.strip() for part in vary.partition("="))
    if not (keys and equals and text):
        raise _vary_error(f"{vary!r} must be KEY=START:STOP:N or KEY=VALUE,VALUE,..., e.g. faults.loss=0:0.9:10")
    values = _parse_range(text) if re.fullmatch(f"{NUMBER}:{NUMBER}(:.*)?", text) else parse_values(text)
    return Axis(split_keys(keys), values)


def split_keys(keys: str) -> tuple[str, ...]:
    """The keys in ``KEY,KEY,...``; a comma in quotes belongs to a key."""
    return tuple(key.strip() for key in re.split(f",{OUTSIDE_QUOTES}", keys))


def sorted_tasks(tasks: Iterable[Task]) -> list[Task]:
    """Tasks in the order of a table: by their values, numbers before words, then by strategy and seed."""
    return sorted(tasks, key=lambda task: ([place_of_value(text) for text in task.values], task.strategy, task.seed))


def place_of_value(text: str) -> tuple[bool, float, str]:
    """Key for sorting values: numbers in their order, then words."""
    number = number_of(text)
    return (number is None, number or 0.0, text)


def number_of(text: str) -> float | None:
    """The number that the text of a value is, None if it is none."""
    value = parse_value(text)
    return float(value) if type(value) in (int, float) else None  # type: ignore[arg-type]


def text_of(value: object) -> str:
    """``value`` as the table of a sweep writes it; equal numbers have one text, 0 and 0.0 too."""
    if isinstance(value, float) and value.is_integer() and abs(value) < 2**53:
        value = int(value)
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
