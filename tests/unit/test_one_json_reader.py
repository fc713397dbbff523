"""JSON and TOML from outside are read in one place, within limits: no other module calls a parser of either."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGES = ("agents", "consensus_dsse", "coordinator", "dsse_core", "scenarios")
READER = "dsse_core/files/bounded_parsing.py"
OPENDSS = "scenarios/importers/opendss"
OF_AN_OWN_PROCESS = {f"{OPENDSS}/engine.py": ["json.load"], f"{OPENDSS}/reader.py": ["json.loads"]}  # what each says
PARSERS = {
    *("json.load", "json.loads", "json.JSONDecoder", "json.decoder", "msgspec.json.decode", "msgspec.json.Decoder"),
    *("msgspec.toml.decode", "msgspec.yaml.decode", "tomllib.load", "tomllib.loads", "tomllib", "ast.literal_eval"),
    *("pydantic_core.from_json", "orjson.loads", "simplejson.loads", "pandas.read_json"),
}
PARSING_METHODS = {"model_validate_json", "validate_json"}  # of pydantic


def parsers_in(source: str) -> Iterator[str]:
    """The parsers that the module ``source`` names, by their full name."""
    tree = ast.parse(source)
    names: dict[str, str] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {
                alias.asname or alias.name.partition(".")[0]: (alias.asname and alias.name)
                or alias.name.partition(".")[0]
                for alias in node.names
            }
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names |= {alias.asname or alias.name: f"{node.module}.{alias.name}" for alias in node.names}
    yield from (name for name in names.values() if name in PARSERS)
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute):
            if node.attr in PARSING_METHODS:
                yield node.attr
            name = ast.unparse(node)
            first, _, rest = name.partition(".")
            if (full := f"{names.get(first, first)}.{rest}") in PARSERS:
                yield full


def test_json_and_toml_are_parsed_by_the_bounded_reader_only() -> None:
    paths = [path for package in PACKAGES for path in (ROOT / package).rglob("*.py")]
    found = {str(path.relative_to(ROOT)): sorted(set(parsers_in(path.read_text(encoding="utf-8")))) for path in paths}
    assert {path: names for path, names in found.items() if names} == {
        READER: ["json.loads", "tomllib", "tomllib.loads"],
        **OF_AN_OWN_PROCESS,
    }


def test_a_parser_is_found_however_it_is_imported() -> None:
    for source in (
        "import json\njson.loads('1')",
        "import json as j\nread = j.load",
        "from json import loads as read",
        "import msgspec\nmsgspec.json.decode(b'1')",
        "from msgspec import json\njson.Decoder(int)",
        "from pydantic_core import from_json",
        "Model.model_validate_json('{}')",
    ):
        assert list(parsers_in(source)), source
    assert not list(parsers_in("import json\njson.dumps(1)\nimport msgspec\nmsgspec.msgpack.decode(b'')"))
