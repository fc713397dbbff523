"""Who may speak: what each certificate may publish, show and hear, and the same as Zenoh's access control.

Whoever forwards messages (a router, or an agent to its neighbours) knows a link by the common name of the certificate
at its other end, and refuses everything that is not allowed here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from agents.keys import (
    all_from_neighbours,
    all_live,
    all_lives,
    all_of_run,
    all_states,
    clock_key,
    neighbour_key,
    state_key,
    telemetry_key,
)

ROUTER, PLANT, COORDINATOR = "router", "plant", "coordinator"
SECOND_ROUTER = f"{ROUTER}2"  # with the certificate of a router, too
ROUTERS = (ROUTER, SECOND_ROUTER)
EVERY_MESSAGE = (
    "put",
    "delete",
    "declare_subscriber",
    "query",
    "reply",
    "declare_queryable",
    "liveliness_token",
    "liveliness_query",
    "declare_liveliness_subscriber",
)


@dataclass(frozen=True)
class Access:
    """All that decides who may speak in ``run``: area -> its neighbours."""

    run: str
    neighbours: Mapping[str, tuple[str, ...]]

    @property
    def names(self) -> tuple[str, ...]:
        """The common names of all certificates of a deployment."""
        return (ROUTER, PLANT, COORDINATOR, *self.neighbours)


@dataclass(frozen=True, slots=True)
class Rights:
    """What one certificate may do; every entry is a key expression.

    Args:
        publishes: messages that it may send.
        shows: presence tokens that it may show, and say farewell on.
        subscribes: subscriptions that it may make.
        hears: messages that are handed to it.
        sees: presence tokens that it may watch, and hear farewells on.
        is_heard_by: subscriptions of others that it is told of, so that it knows that somebody listens.
    """

    publishes: tuple[str, ...]
    shows: tuple[str, ...]
    subscribes: tuple[str, ...]
    hears: tuple[str, ...]
    sees: tuple[str, ...]
    is_heard_by: tuple[str, ...]


def find_rights(access: Access) -> dict[str, Rights]:
    """Common name -> its rights, of all but routers: they pass on what others say."""
    return {
        PLANT: _rights_of_plant(access),
        COORDINATOR: _rights_of_coordinator(access),
        **{area: _rights_of_area(access, area) for area in access.neighbours},
    }


def _rights_of_area(access: Access, area: str) -> Rights:
    run, neighbours = access.run, access.neighbours[area]
    to_neighbours = tuple(neighbour_key(run, area, "*", n) for n in neighbours)
    return Rights(
        publishes=(*to_neighbours, state_key(run, area)),
        shows=(all_lives(run, "area", area),),
        subscribes=(all_from_neighbours(run, area), telemetry_key(run, area), clock_key(run)),
        hears=(*(neighbour_key(run, n, "*", area) for n in neighbours), telemetry_key(run, area), clock_key(run)),
        sees=tuple(all_lives(run, "area", n) for n in (area, *neighbours)),
        is_heard_by=(*(all_from_neighbours(run, n) for n in neighbours), all_states(run), all_live(run)),
    )


def _rights_of_plant(access: Access) -> Rights:
    telemetry = tuple(telemetry_key(access.run, area) for area in access.neighbours)
    return Rights(
        publishes=telemetry,
        shows=(all_lives(access.run, "plant", PLANT),),
        subscribes=(),
        hears=(),
        sees=(all_lives(access.run, "area", "*"), all_lives(access.run, "plant", PLANT)),
        is_heard_by=(*telemetry, all_live(access.run)),
    )


def _rights_of_coordinator(access: Access) -> Rights:
    return Rights(
        publishes=(clock_key(access.run),),
        shows=(all_lives(access.run, "coordinator", COORDINATOR),),
        subscribes=(all_states(access.run),),
        hears=(all_states(access.run),),
        sees=(all_live(access.run),),
        is_heard_by=(clock_key(access.run),),
    )


def zenoh_access_control(access: Access) -> dict[str, Any]:
    """The rules as Zenoh's configuration ``access_control``: what is not allowed is refused."""
    rules: list[dict[str, Any]] = []
    policies = []
    for name, rights in find_rights(access).items():
        own = [
            _rule(f"{name}-{flow}-{messages[0]}", flow, messages, keys)
            for flow, messages, keys in _table(rights)
            if keys
        ]
        rules += own
        policies.append({"rules": [rule["id"] for rule in own], "subjects": [name]})
    for flow in ("ingress", "egress"):
        rules.append(_rule(f"{ROUTER}-{flow}", flow, EVERY_MESSAGE, (all_of_run(access.run),)))
    policies.append({"rules": [f"{ROUTER}-ingress", f"{ROUTER}-egress"], "subjects": [ROUTER]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [{"id": name, "cert_common_names": [name]} for name in access.names],
        "policies": policies,
    }


def _table(rights: Rights) -> tuple[tuple[str, tuple[str, ...], tuple[str, ...]], ...]:
    """(from or to the certificate's owner, kinds of message, key expressions)"""
    return (
        ("ingress", ("put",), rights.publishes),
        ("ingress", ("liveliness_token", "put"), rights.shows),
        ("ingress", ("declare_subscriber",), rights.subscribes),
        ("ingress", ("declare_liveliness_subscriber", "liveliness_query", "declare_subscriber"), rights.sees),
        ("egress", ("put",), rights.hears),
        ("egress", ("liveliness_token", "put"), rights.sees),
        ("egress", ("declare_subscriber",), rights.is_heard_by),
    )


def _rule(name: str, flow: str, messages: tuple[str, ...], keys: tuple[str, ...]) -> dict[str, Any]:
    return {"id": name, "permission": "allow", "flows": [flow], "messages": list(messages), "key_exprs": list(keys)}
