"""Access rights: keys that each certificate may publish on, show and receive; the same as Zenoh's access control.

Every process applies these rights to every link of its own, whichever end called. The common name of the certificate,
not the address, identifies the process at the other end. Everything that is not allowed here is rejected.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from agents.messages.keys import (
    all_commands,
    all_from_neighbours,
    all_gateways,
    all_incarnations,
    all_live,
    all_of_run,
    all_readings,
    all_states,
    all_telemetry,
    clock_key,
    command_key,
    gateway_key,
    neighbour_key,
    of_any_version,
    readings_key,
    state_key,
    telemetry_key,
)
from dsse_core.reading_rules import ANYBODY, ReadingRules

if TYPE_CHECKING:  # a router needs no grid
    from dsse_core.grid.partition import Partition

ROUTER, PLANT, COORDINATOR, OPERATOR, WATCHER = "router", "plant", "coordinator", "operator", "watcher"
ROLES = (ROUTER, PLANT, COORDINATOR, OPERATOR, WATCHER)
GATEWAY_ = "gateway-"  # beginning of the common names of gateways
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
PUBLISHING = ("put", "delete", "liveliness_token")
SUBSCRIBING = ("declare_liveliness_subscriber", "liveliness_query", "declare_subscriber")  # the first names a rule
REVOKED = "/revoked"  # a rule's name that is no area's


@dataclass(frozen=True)
class Access:
    """Facts from which the rights of all processes in ``run`` follow.

    ``neighbours``: area -> its neighbours. ``revoked``: names of stolen keys. ``gateways``: gateway ->
    the areas to which it may send readings; the plant may to all, unless it stands there as ``plant``.
    """

    run: str
    neighbours: Mapping[str, tuple[str, ...]]
    revoked: tuple[str, ...] = ()
    gateways: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    @property
    def names(self) -> tuple[str, ...]:
        """The common names of all certificates of a deployment."""
        return (*ROLES, *self.gateways_by_name, *self.neighbours)

    @property
    def gateways_by_name(self) -> Mapping[str, str]:
        """Common name of each gateway but the plant -> the gateway."""
        return {f"{GATEWAY_}{gateway}": gateway for gateway in self.gateways if gateway != PLANT}

    def areas_of(self, gateway: str) -> tuple[str, ...]:
        """The areas to which ``gateway`` may send readings."""
        return self.gateways.get(gateway, tuple(self.neighbours) if gateway == PLANT else ())

    def gateways_of(self, area: str) -> tuple[str, ...]:
        """The gateways that may send readings to ``area``, the plant among them."""
        return tuple(g for g in dict.fromkeys((PLANT, *self.gateways)) if area in self.areas_of(g))

    def met_directly_by(self, name: str) -> tuple[str, ...]:
        """Names of the processes that ``name`` links with where there is no router.

        An area links with its neighbours, its gateways, plant, coordinator, operator and watcher; a gateway with its
        areas; each of the others with all areas.
        """
        if name not in self.neighbours:
            gateway = self.gateways_by_name.get(name)
            return tuple(self.neighbours) if gateway is None else self.areas_of(gateway)
        gateways = (own for own, gateway in self.gateways_by_name.items() if name in self.areas_of(gateway))
        return (*self.neighbours[name], PLANT, COORDINATOR, OPERATOR, WATCHER, *gateways)


def find_name_problems(access: Access) -> Iterator[str]:
    """Areas whose certificate would have the name of another process, and gateways of areas that do not exist."""
    for name, count in Counter(access.names).items():
        if count > 1:
            yield f"neighbours: no area can be called {name!r}, as another process is; name the area otherwise"
    for gateway, areas in access.gateways.items():
        for area in areas:
            if area not in access.neighbours:
                yield f"gateways.{gateway}: there is no area {area!r}; the areas are {', '.join(access.neighbours)}"


@dataclass(frozen=True, slots=True)
class Rights:
    """Rights of one certificate; every entry is a key expression.

    Args:
        publishes: messages that it may send.
        shows: presence tokens that it may show, and send leave messages on.
        subscribes: subscriptions that it may make.
        receives: messages that are handed to it.
        sees: presence tokens that it may watch, and receive leave messages on.
        is_received_by: subscriptions of other processes that it gets, so that it knows of its receivers.
    """

    publishes: tuple[str, ...]
    shows: tuple[str, ...]
    subscribes: tuple[str, ...]
    receives: tuple[str, ...]
    sees: tuple[str, ...]
    is_received_by: tuple[str, ...]


def find_rights(access: Access) -> dict[str, Rights]:
    """Common name -> its rights, of all but routers: they pass on the messages of others."""
    return {
        PLANT: _rights_of_plant(access),
        COORDINATOR: _rights_of_coordinator(access),
        OPERATOR: _rights_of_operator(access),
        WATCHER: _rights_of_watcher(access),
        **{name: _rights_of_gateway(access, gateway) for name, gateway in access.gateways_by_name.items()},
        **{area: _rights_of_area(access, area) for area in access.neighbours},
    }


def _rights_of_area(access: Access, area: str) -> Rights:
    run, neighbours = access.run, access.neighbours[area]
    to_neighbours = tuple(neighbour_key(run, area, "*", n) for n in neighbours)
    telemetry = tuple(telemetry_key(run, area, gateway) for gateway in access.gateways_of(area))
    from_anybody = (command_key(run, area), clock_key(run))
    return Rights(
        publishes=(*to_neighbours, state_key(run, area), readings_key(run, area)),
        shows=(all_incarnations(run, "area", area),),
        subscribes=(all_from_neighbours(run, area), all_telemetry(run, area), *from_anybody),
        receives=(*(neighbour_key(run, n, "*", area) for n in neighbours), *telemetry, *from_anybody),
        sees=tuple(all_incarnations(run, "area", n) for n in (area, *neighbours)),
        is_received_by=(
            *(all_from_neighbours(run, n) for n in neighbours),
            all_states(run),
            all_readings(run),
            all_live(run),
        ),
    )


def _rights_of_plant(access: Access) -> Rights:
    run, areas = access.run, access.areas_of(PLANT)
    command = command_key(run, PLANT)
    return Rights(
        publishes=tuple(telemetry_key(run, area) for area in areas),
        shows=(all_incarnations(run, "plant", PLANT),),
        subscribes=(command, clock_key(run)),
        receives=(command, clock_key(run)),
        sees=(all_incarnations(run, "area", "*"), all_incarnations(run, "plant", PLANT)),
        is_received_by=(*(all_telemetry(run, area) for area in areas), all_live(run)),
    )


def _rights_of_gateway(access: Access, gateway: str) -> Rights:
    """Rights of ``gateway``, which also receives the states of its areas, to pass the results on."""
    run, areas, own_tokens = access.run, access.areas_of(gateway), all_incarnations(access.run, "gateway", gateway)
    return Rights(
        publishes=(*(telemetry_key(run, area, gateway) for area in areas), gateway_key(run, gateway)),
        shows=(own_tokens,),
        subscribes=(all_states(run),),
        receives=tuple(state_key(run, area) for area in areas),
        sees=(all_incarnations(run, "area", "*"), own_tokens),
        is_received_by=(*(all_telemetry(run, area) for area in areas), all_gateways(run), all_live(run)),
    )


def _rights_of_coordinator(access: Access) -> Rights:
    run, everything = access.run, _for_watchers(access)
    return Rights(
        publishes=(clock_key(run),),
        shows=(all_incarnations(run, "coordinator", COORDINATOR),),
        subscribes=everything,
        receives=everything,
        sees=(all_live(run),),
        is_received_by=(clock_key(run),),
    )


def _rights_of_operator(access: Access) -> Rights:
    run, everything = access.run, _for_watchers(access)
    commands = tuple(command_key(run, name) for name in (*access.neighbours, PLANT))
    return Rights(
        publishes=commands,
        shows=(),
        subscribes=everything,
        receives=everything,
        sees=(all_live(run),),
        is_received_by=(*commands, all_commands(run)),
    )


def _rights_of_watcher(access: Access) -> Rights:
    everything, tokens = _for_watchers(access), (all_live(access.run),)
    return Rights(publishes=(), shows=(), subscribes=everything, receives=everything, sees=tokens, is_received_by=())


def _for_watchers(access: Access) -> tuple[str, ...]:
    return all_states(access.run), all_readings(access.run), all_commands(access.run), all_gateways(access.run)


def zenoh_access_control(access: Access, meets: Iterable[str]) -> dict[str, Any]:
    """The rules for links with ``meets`` as Zenoh's configuration ``access_control``; the default is rejection.

    A link with another name, or with a revoked one, may open, and nothing passes on it. Messages and tokens on the
    keys of revoked names are rejected, also where another process passes them on.
    """
    names = [name for name in meets if name not in access.revoked]
    rights = find_rights(access)
    own = _keys_of_revoked(access)
    rules = [_rule(REVOKED, "deny", ("ingress", "egress"), PUBLISHING, own)] if own else []
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


def zenoh_access_control_without_keys(access: Access) -> dict[str, Any]:
    """The rules of a router without keys that knows the processes of a run.

    Any process may publish on, and subscribe to, the keys of all processes of the run. Messages and tokens under other
    names are rejected at the link, before the router notes them.
    """
    rights = find_rights(access).values()
    published = {key: None for r in rights for key in (*r.publishes, *map(of_any_version, r.shows))}
    subscribed = {key: None for r in rights for key in (*r.subscribes, *r.sees)}
    published |= dict.fromkeys(of_any_version(state_key(access.run, area)) for area in access.neighbours)
    # for watchers without keys, which name programs of other versions
    every_version = map(of_any_version, (all_live(access.run), all_states(access.run), all_states("*")))
    rules = [
        _rule("published", "allow", ("ingress",), ("put", "liveliness_token"), tuple(published)),
        _rule("subscribed", "allow", ("ingress",), SUBSCRIBING, (*subscribed, *every_version)),
        _rule("passed on", "allow", ("egress",), EVERY_MESSAGE, ("**",)),
    ]
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [{"id": ANYBODY}],
        "policies": [{"rules": [rule["id"] for rule in rules], "subjects": [ANYBODY]}],
    }


def _keys_of_revoked(access: Access) -> tuple[str, ...]:
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
    """Rows (flow from or to the certificate's owner, kinds of message, key expressions)."""
    return (
        ("ingress", ("put",), rights.publishes),
        ("ingress", ("liveliness_token", "put"), rights.shows),
        ("ingress", ("declare_subscriber",), rights.subscribes),
        ("ingress", SUBSCRIBING, rights.sees),
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


def access_of(partition: Partition, run: str, rules: Mapping[str, ReadingRules] | None = None) -> Access:
    """Neighbours of each area of ``partition``, and the areas that each gateway sends readings to.

    ``rules``: area -> the rules of its readings; None: the plant sends to all areas.
    """
    neighbours = {area.name: tuple(sorted({n.area for n in area.neighbours})) for area in partition.areas}
    gateways: dict[str, tuple[str, ...]] = {}
    for area, its_rules in (rules or {}).items():
        for gateway in its_rules.gateways:
            gateways[gateway] = (*gateways.get(gateway, ()), area)
    has_strangers = gateways.pop(ANYBODY, None) is not None
    if len(gateways.get(PLANT, ())) == len(neighbours):
        del gateways[PLANT]  # as where nothing is given
    elif rules and not has_strangers:
        gateways.setdefault(PLANT, ())
    return Access(run, neighbours, gateways=gateways)


def access_without_keys(partition: Partition, run: str, rules: Mapping[str, ReadingRules]) -> Access:
    """Access of a run without certificates: gateways may have any name where the rules of the readings allow it."""
    access = access_of(partition, run, rules)
    if any(ANYBODY in of_area.gateways for of_area in rules.values()):
        return replace(access, gateways={**access.gateways, ANYBODY: tuple(access.neighbours)})
    return access
