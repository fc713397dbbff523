"""The rules of who may speak, as data: a table of what each certificate may and may not do."""

from dataclasses import replace
from pathlib import Path

import pytest
import zenoh

from agents.security.access import Access, zenoh_access_control
from agents.security.access_file import load_access, save_access
from dsse_core.errors import InvalidInputError

CHAIN = Access("run", {"a": ("b",), "b": ("a", "c"), "c": ("b",)}, gateways={"north": ("a", "b"), "south": ("c",)})


def may(name: str, flow: str, message: str, key: str, access: Access = CHAIN, meets: tuple[str, ...] = ()) -> bool:
    """What Zenoh decides: a rule of the name's policies that allows it includes the key, and none that denies."""
    control = zenoh_access_control(access, meets or access.names)
    assert control["default_permission"] == "deny"
    rules = {rule["id"]: rule for rule in control["rules"]}
    subjects = {s["id"] for s in control["subjects"] if name in s["cert_common_names"]}
    published = [
        rule["permission"]
        for policy in control["policies"]
        if subjects & set(policy["subjects"])
        for rule in (rules[name] for name in policy["rules"])
        if flow in rule["flows"]
        and message in rule["messages"]
        and any(zenoh.KeyExpr(allowed).includes(f"dsse/v3/{key}") for allowed in rule["key_exprs"])
    ]
    return "allow" in published and "deny" not in published


ALLOWED = [
    ("a", "ingress", "put", "run/area/a/information/b"),
    ("a", "ingress", "put", "run/area/a/tally/b"),
    ("a", "ingress", "put", "run/area/a/state"),
    ("a", "ingress", "liveliness_token", "run/live/area/a/1-2"),
    ("a", "ingress", "declare_subscriber", "run/area/*/*/a"),
    ("a", "ingress", "declare_subscriber", "run/telemetry/a/plant"),
    ("a", "ingress", "declare_liveliness_subscriber", "run/live/area/b/*"),
    ("a", "egress", "put", "run/area/b/information/a"),
    ("a", "egress", "put", "run/telemetry/a/plant"),
    ("a", "egress", "liveliness_token", "run/live/area/b/1-2"),
    ("a", "ingress", "declare_liveliness_subscriber", "run/live/area/a/*"),
    ("a", "egress", "liveliness_token", "run/live/area/a/1-2"),
    ("b", "ingress", "put", "run/area/b/information/c"),
    ("plant", "ingress", "put", "run/telemetry/c/plant"),
    ("plant", "ingress", "liveliness_token", "run/live/plant/plant/1-2"),
    ("plant", "ingress", "declare_liveliness_subscriber", "run/live/area/*/*"),
    ("plant", "ingress", "declare_liveliness_subscriber", "run/live/plant/plant/*"),
    ("coordinator", "ingress", "declare_subscriber", "run/area/*/state"),
    ("coordinator", "egress", "put", "run/area/c/state"),
    ("coordinator", "ingress", "declare_liveliness_subscriber", "run/live/*/*/*"),
    ("coordinator", "ingress", "put", "run/clock"),
    ("a", "egress", "put", "run/clock"),
    ("a", "ingress", "put", "run/area/a/readings"),
    ("a", "ingress", "declare_subscriber", "run/telemetry/a/*"),
    ("a", "egress", "put", "run/telemetry/a/north"),
    ("a", "ingress", "declare_subscriber", "run/command/a"),
    ("a", "egress", "put", "run/command/a"),
    ("plant", "ingress", "declare_subscriber", "run/command/plant"),
    ("plant", "egress", "put", "run/command/plant"),
    ("gateway-north", "ingress", "put", "run/telemetry/a/north"),
    ("gateway-north", "ingress", "put", "run/telemetry/b/north"),
    ("gateway-north", "ingress", "liveliness_token", "run/live/gateway/north/1-2"),
    ("gateway-north", "ingress", "declare_liveliness_subscriber", "run/live/area/*/*"),
    ("gateway-north", "ingress", "declare_liveliness_subscriber", "run/live/gateway/north/*"),
    ("gateway-north", "ingress", "declare_subscriber", "run/area/*/state"),
    ("gateway-north", "egress", "put", "run/area/a/state"),
    ("gateway-north", "ingress", "put", "run/gateway/north"),
    ("gateway-north", "egress", "declare_subscriber", "run/gateway/*"),
    ("operator", "ingress", "put", "run/command/a"),
    ("operator", "ingress", "put", "run/command/plant"),
    ("operator", "ingress", "declare_subscriber", "run/area/*/state"),
    ("operator", "egress", "put", "run/area/c/state"),
    ("operator", "egress", "put", "run/area/c/readings"),
    ("operator", "egress", "declare_subscriber", "run/command/a"),
    ("operator", "egress", "declare_subscriber", "run/command/plant"),
    ("operator", "ingress", "declare_liveliness_subscriber", "run/live/*/*/*"),
    ("watcher", "ingress", "declare_subscriber", "run/area/*/state"),
    ("watcher", "ingress", "declare_subscriber", "run/area/*/readings"),
    ("watcher", "ingress", "declare_subscriber", "run/command/*"),
    ("watcher", "ingress", "declare_subscriber", "run/gateway/*"),
    ("watcher", "egress", "put", "run/gateway/north"),
    ("watcher", "egress", "put", "run/area/c/readings"),
    ("watcher", "egress", "put", "run/command/c"),
    ("watcher", "egress", "liveliness_token", "run/live/gateway/north/1-2"),
    ("coordinator", "ingress", "declare_subscriber", "run/area/*/readings"),
    ("router", "ingress", "put", "run/area/c/state"),
    ("router", "egress", "liveliness_token", "run/live/area/b/1-2"),
]

REJECTED = [
    ("a", "ingress", "put", "run/area/b/information/a"),  # as somebody else
    ("a", "ingress", "put", "run/area/a/information/c"),  # to an area that is no neighbour
    ("a", "ingress", "put", "run/area/b/state"),
    ("a", "ingress", "put", "run/telemetry/a/plant"),
    ("a", "ingress", "put", "other/area/a/state"),
    ("a", "ingress", "delete", "run/area/a/state"),
    ("a", "ingress", "liveliness_token", "run/live/area/b/1-2"),
    ("a", "ingress", "liveliness_token", "run/live/plant/plant/1-2"),
    ("a", "ingress", "declare_queryable", "run/area/a/state"),
    ("a", "ingress", "declare_subscriber", "run/**"),
    ("a", "ingress", "declare_subscriber", "run/area/*/*/b"),
    ("a", "ingress", "declare_subscriber", "run/area/*/state"),
    ("a", "ingress", "declare_subscriber", "run/telemetry/b/plant"),
    ("a", "ingress", "declare_liveliness_subscriber", "run/live/area/c/*"),
    ("a", "ingress", "declare_liveliness_subscriber", "run/live/area/*/*"),
    ("a", "ingress", "query", "run/area/b/state"),
    ("a", "egress", "put", "run/area/c/information/a"),  # from an area that is no neighbour
    ("a", "egress", "put", "run/area/b/information/c"),
    ("plant", "ingress", "put", "run/area/a/state"),
    ("plant", "ingress", "put", "run/area/b/information/a"),
    ("plant", "ingress", "declare_subscriber", "run/area/*/state"),
    ("plant", "ingress", "liveliness_token", "run/live/area/a/1-2"),
    ("coordinator", "ingress", "put", "run/area/a/state"),
    ("coordinator", "ingress", "put", "run/telemetry/a/plant"),
    ("coordinator", "ingress", "declare_subscriber", "run/area/*/*/b"),
    ("coordinator", "ingress", "declare_subscriber", "run/telemetry/*"),
    ("a", "ingress", "put", "run/clock"),
    ("plant", "ingress", "put", "run/clock"),
    ("a", "ingress", "put", "run/telemetry/a/north"),
    ("a", "ingress", "put", "run/area/b/readings"),
    ("a", "ingress", "put", "run/command/a"),
    ("a", "ingress", "declare_subscriber", "run/telemetry/*/north"),
    ("a", "ingress", "declare_subscriber", "run/command/*"),
    ("a", "egress", "put", "run/telemetry/a/south"),  # whose areas are others
    ("a", "egress", "put", "run/command/b"),
    ("plant", "ingress", "put", "run/telemetry/a/north"),
    ("plant", "ingress", "put", "run/command/a"),
    ("gateway-north", "ingress", "put", "run/telemetry/c/north"),
    ("gateway-north", "ingress", "put", "run/telemetry/a/south"),
    ("gateway-north", "ingress", "put", "run/telemetry/a/plant"),
    ("gateway-north", "ingress", "put", "run/gateway/south"),
    ("gateway-north", "ingress", "put", "run/area/a/state"),
    ("gateway-north", "ingress", "put", "run/area/a/readings"),
    ("gateway-north", "ingress", "put", "run/area/a/information/b"),
    ("gateway-north", "ingress", "put", "run/command/a"),
    ("gateway-north", "ingress", "put", "run/clock"),
    ("gateway-north", "ingress", "liveliness_token", "run/live/gateway/south/1-2"),
    ("gateway-north", "ingress", "liveliness_token", "run/live/area/a/1-2"),
    ("gateway-north", "ingress", "liveliness_token", "run/live/plant/plant/1-2"),
    ("gateway-north", "ingress", "declare_subscriber", "run/telemetry/a/*"),
    ("gateway-north", "ingress", "declare_subscriber", "run/area/*/readings"),
    ("gateway-north", "egress", "put", "run/area/c/state"),
    ("gateway-north", "egress", "put", "run/telemetry/a/plant"),
    ("operator", "ingress", "put", "run/telemetry/a/plant"),
    ("operator", "ingress", "put", "run/area/a/state"),
    ("operator", "ingress", "put", "run/clock"),
    ("operator", "ingress", "liveliness_token", "run/live/area/a/1-2"),
    ("watcher", "ingress", "put", "run/command/a"),
    ("watcher", "ingress", "put", "run/clock"),
    ("watcher", "ingress", "put", "run/area/a/state"),
    ("watcher", "ingress", "put", "run/telemetry/a/plant"),
    ("watcher", "ingress", "liveliness_token", "run/live/coordinator/coordinator/1-2"),
    ("watcher", "ingress", "declare_subscriber", "run/area/*/*/b"),
    ("coordinator", "ingress", "put", "run/command/a"),
    ("router", "ingress", "put", "other/area/c/state"),
    ("somebody", "ingress", "put", "run/area/a/state"),
    ("authority", "ingress", "put", "run/area/a/state"),
]


@pytest.mark.parametrize(("name", "flow", "message", "key"), ALLOWED)
def test_what_a_process_needs_is_allowed(name: str, flow: str, message: str, key: str):
    assert may(name, flow, message, key)


@pytest.mark.parametrize(("name", "flow", "message", "key"), REJECTED)
def test_everything_else_is_rejected(name: str, flow: str, message: str, key: str):
    assert not may(name, flow, message, key)


def test_nobody_has_rights_on_links_that_do_not_exist():
    assert may("router", "ingress", "put", "run/area/b/state", meets=("router",))
    assert not may("b", "ingress", "put", "run/area/b/state", meets=("router",))
    for caller in ("a", "plant", "coordinator", "operator", "watcher", "gateway-north"):
        meets = CHAIN.met_directly_by(caller)
        assert not may("router", "ingress", "put", "run/area/b/state", meets=meets)
        assert may("b", "ingress", "liveliness_token", "run/live/area/b/1-2", meets=meets)
    assert not may("c", "ingress", "liveliness_token", "run/live/area/c/1-2", meets=CHAIN.met_directly_by("a"))
    assert may("gateway-north", "ingress", "put", "run/telemetry/a/north", meets=CHAIN.met_directly_by("a"))
    assert not may("gateway-south", "ingress", "put", "run/telemetry/c/south", meets=CHAIN.met_directly_by("a"))


def test_a_plant_that_is_named_among_the_gateways_sends_to_its_areas_alone():
    access = replace(CHAIN, gateways={"plant": ("b",)})
    assert access.names == ("router", "plant", "coordinator", "operator", "watcher", "a", "b", "c")
    assert may("plant", "ingress", "put", "run/telemetry/b/plant", access)
    assert not may("plant", "ingress", "put", "run/telemetry/a/plant", access)
    assert not may("a", "egress", "put", "run/telemetry/a/plant", access)


@pytest.mark.parametrize(
    ("revoked", "key", "token"),
    [
        ("b", "area/b/state", "area/b"),
        ("b", "area/b/information/a", "area/b"),
        ("plant", "telemetry/a/plant", "plant/plant"),
        ("gateway-north", "telemetry/a/north", "gateway/north"),
    ],
)
@pytest.mark.parametrize("flow", ["ingress", "egress"])
def test_what_a_revoked_name_says_is_rejected_from_routers_too(revoked: str, key: str, token: str, flow: str):
    assert may("router", flow, "put", f"run/{key}")
    access = replace(CHAIN, revoked=(revoked,))
    for name in (revoked, "router"):
        assert not may(name, flow, "put", f"run/{key}", access)
        assert not may(name, flow, "liveliness_token", f"run/live/{token}/1-2", access)
    assert may("router", flow, "put", "run/area/a/state", access)
    assert may("a", "ingress", "put", "run/area/a/state", access)


def test_an_area_without_neighbours_needs_no_rules_about_any():
    alone = Access("run", {"a": ()})
    assert may("a", "ingress", "put", "run/area/a/state", alone)
    assert all(rule["key_exprs"] for rule in zenoh_access_control(alone, alone.names)["rules"])


def test_the_access_file_brings_the_rules_back(tmp_path: Path):
    for access in (CHAIN, replace(CHAIN, revoked=("c", "plant"))):
        save_access(tmp_path / "access.toml", access)
        assert load_access(tmp_path / "access.toml") == access


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("run = 3\n[neighbours]\na = []", "run: "),
        ('run = "r"', "neighbours: missing; area"),
        ('run = "r"\ncolour = 1\n[neighbours]\na = []', "colour: unknown key"),
        ('run = "r"\n[neighbours]\na = ["b"]\nb = []', "'b' does not name 'a' as its neighbour; add it there"),
        ('run = "r"\n[neighbours]\na = ["a"]', "neighbours.a: names 'a' itself; remove it there"),
        ('run = "r"\n[neighbours]\n"a/**" = []', "neighbours.a/**: must match pattern '^[_a-z0-9-]+$'"),
        ("run = ", "not valid TOML"),
        *(
            (f'run = "r"\n[neighbours]\n{role} = []', f"no area can be called '{role}', as another process is")
            for role in ("router", "plant", "coordinator", "operator", "watcher")
        ),
        (
            'run = "r"\n[neighbours]\ngateway-b = []\n[gateways]\nb = ["gateway-b"]',
            "no area can be called 'gateway-b', as another process is",
        ),
        (
            'run = "r"\n[neighbours]\na = []\n[gateways]\nb = ["z"]',
            "gateways.b: there is no area 'z'; the areas are a",
        ),
        (
            'run = "r"\nrevoked = ["z"]\n[neighbours]\na = []',
            "revoked: 'z' is no name of a certificate: router, plant,",
        ),
        ('run = "r"\nrevoked = ["router"]\n[neighbours]\na = []', "revoked: 'router' would end all exchange; replace"),
        ('run = "r"\n[neighbours]\na = []\nrevoked = ["a"]', "neighbours.revoked: 'a' does not name 'revoked'"),
        (None, "`dsse keys create SCENARIO` writes: 1 problem\n  - cannot be read: No such file or directory"),
    ],
)
def test_a_wrong_access_file_is_rejected_with_what_is_wrong(tmp_path: Path, text: str | None, expected: str):
    if text is not None:
        (tmp_path / "access.toml").write_text(text)
    with pytest.raises(InvalidInputError) as caught:
        load_access(tmp_path / "access.toml")
    assert str(tmp_path / "access.toml") in str(caught.value)
    assert expected in str(caught.value)
