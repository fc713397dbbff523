"""Who may speak: what each certificate may publish, show and receive, and the same as Zenoh's access control.

Every process applies this to every link of its own, whichever end called: the common name of the certificate at the
other end says who that is, not the place where it was found, and everything that is not allowed here is rejected.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from agents.messages.keys import (
    all_from_neighbours,
    all_incarnations,
    all_live,
    all_of_run,
    all_states,
    all_telemetry,
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
SPOKEN = ("put", "delete", "liveliness_token")
REVOKED = "/revoked"  # a rule's name that is no area's


@dataclass(frozen=True)
class Access:
    """All that decides who may speak in ``run``: area -> its neighbours, and names whose keys are in wrong hands."""

    run: str
    neighbours: Mapping[str, tuple[str, ...]]
    revoked: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """The common names of all certificates of a deployment."""
        return (ROUTER, PLANT, COORDINATOR, *self.neighbours)

    def met_directly_by(self, name: str) -> tuple[str, ...]:
        """Whom ``name`` links with where there is no router: a plant and a watcher with all areas."""
        return (*self.neighbours[name], PLANT, COORDINATOR) if name in self.neighbours else tuple(self.neighbours)


@dataclass(frozen=True, slots=True)
class Rights:
    """What one certificate may do; every entry is a key expression.

    Args:
        publishes: messages that it may send.
        shows: presence tokens that it may show, and send leave messages on.
        subscribes: subscriptions that it may make.
        receives: messages that are handed to it.
        sees: presence tokens that it may watch, and receive leave messages on.
        is_received_by: subscriptions of others that it gets, so that it knows that somebody listens.
    """

    publishes: tuple[str, ...]
    shows: tuple[str, ...]
    subscribes: tuple[str, ...]
    receives: tuple[str, ...]
    sees: tuple[str, ...]
    is_received_by: tuple[str, ...]


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
        shows=(all_incarnations(run, "area", area),),
        subscribes=(all_from_neighbours(run, area), all_telemetry(run, area), clock_key(run)),
        receives=(*(neighbour_key(run, n, "*", area) for n in neighbours), telemetry_key(run, area), clock_key(run)),
        sees=tuple(all_incarnations(run, "area", n) for n in (area, *neighbours)),
        is_received_by=(*(all_from_neighbours(run, n) for n in neighbours), all_states(run), all_live(run)),
    )


def _rights_of_plant(access: Access) -> Rights:
    telemetry = tuple(telemetry_key(access.run, area) for area in access.neighbours)
    return Rights(
        publishes=telemetry,
        shows=(all_incarnations(access.run, "plant", PLANT),),
        subscribes=(),
        receives=(),
        sees=(all_incarnations(access.run, "area", "*"), all_incarnations(access.run, "plant", PLANT)),
        is_received_by=(*(all_telemetry(access.run, area) for area in access.neighbours), all_live(access.run)),
    )


def _rights_of_coordinator(access: Access) -> Rights:
    return Rights(
        publishes=(clock_key(access.run),),
        shows=(all_incarnations(access.run, "coordinator", COORDINATOR),),
        subscribes=(all_states(access.run),),
        receives=(all_states(access.run),),
        sees=(all_live(access.run),),
        is_received_by=(clock_key(access.run),),
    )


def zenoh_access_control(access: Access, meets: Iterable[str]) -> dict[str, Any]:
    """The rules for links with ``meets`` as Zenoh's configuration ``access_control``: what is not allowed is rejected.

    A link with anybody else, or with a revoked name, may be there, and nothing passes. What revoked names alone may
    say is rejected, also where another process passes it on.
    """
    names = [name for name in meets if name not in access.revoked]
    rights = find_rights(access)
    rules = [_rule(REVOKED, "deny", ("ingress", "egress"), SPOKEN, own)] if (own := _said_by_revoked(access)) else []
    policies = []
    for name in names:
        allowed = _rules_of_router(access) if name == ROUTER else _rules_of(name, rights[name])
        policies.append({"rules": [rule["id"] for rule in (*rules[: bool(own)], *allowed)], "subjects": [name]})
        rules += allowed
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [{"id": name, "cert_common_names": [name]} for name in names],
        "policies": policies,
    }


def _said_by_revoked(access: Access) -> tuple[str, ...]:
    rights = find_rights(access)
    return tuple(key for name in access.revoked for key in (*rights[name].publishes, *rights[name].shows))


def _rules_of(name: str, rights: Rights) -> list[dict[str, Any]]:
    return [
        _rule(f"{name}-{flow}-{messages[0]}", "allow", (flow,), messages, keys)
        for flow, messages, keys in _table(rights)
        if keys
    ]


def _rules_of_router(access: Access) -> list[dict[str, Any]]:
    return [_rule(ROUTER, "allow", ("ingress", "egress"), EVERY_MESSAGE, (all_of_run(access.run),))]


def _table(rights: Rights) -> tuple[tuple[str, tuple[str, ...], tuple[str, ...]], ...]:
    """(from or to the certificate's owner, kinds of message, key expressions)"""
    return (
        ("ingress", ("put",), rights.publishes),
        ("ingress", ("liveliness_token", "put"), rights.shows),
        ("ingress", ("declare_subscriber",), rights.subscribes),
        ("ingress", ("declare_liveliness_subscriber", "liveliness_query", "declare_subscriber"), rights.sees),
        ("egress", ("put",), rights.receives),
        ("egress", ("liveliness_token", "put"), rights.sees),
        ("egress", ("declare_subscriber",), rights.is_received_by),
    )


def _rule(
    name: str, permission: str, flows: tuple[str, ...], messages: tuple[str, ...], keys: tuple[str, ...]
) -> dict[str, Any]:
    return {
        "id": name,
        "permission": permission,
        "flows": list(flows),
        "messages": list(messages),
        "key_exprs": list(keys),
    }
