"""Keys: what is created, and what is reported about files that cannot be used."""

import datetime
import os
import shutil
import stat
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.x509.oid import ExtendedKeyUsageOID

from agents.security.access import Access, access_of
from agents.security.access_file import ACCESS_FILE, load_access, save_access
from agents.security.credential_files import credentials_in
from agents.security.credentials import load_keys
from coordinator.cli.main import run_command
from coordinator.lab.deployment.certificates import HERE, check_keys, create_keys
from dsse_core.errors import InvalidInputError
from dsse_core.reading_rules import ANYBODY, ReadingRules
from scenarios.scenario import load_scenario

ACCESS = Access("grid", {"area1": ("area2",), "area2": ("area1",)})


@pytest.fixture
def keys(tmp_path: Path) -> Path:
    create_keys(tmp_path / "keys", ACCESS, days=10, hosts=["grid-a.example", "192.0.2.7"])
    return tmp_path / "keys"


def problems_of(folder: Path, name: str = "area1") -> str:
    with pytest.raises(InvalidInputError) as caught:
        load_keys(folder, name)
    return str(caught.value)


def test_every_process_gets_a_certificate_of_the_same_authority_and_a_key_of_its_own(keys: Path):
    check_keys(keys, ACCESS)
    authority = x509.load_pem_x509_certificate((keys / "authority.crt").read_bytes())
    for name in ("router", "plant", "coordinator", "operator", "watcher", "area1", "area2"):
        certificate = x509.load_pem_x509_certificate((keys / f"{name}.crt").read_bytes())
        certificate.verify_directly_issued_by(authority)
        assert certificate.subject.rfc4514_string() == f"CN={name}"
        left = certificate.not_valid_after_utc - datetime.datetime.now(datetime.UTC)
        assert datetime.timedelta(days=9) < left < datetime.timedelta(days=10)
    assert len({path.read_bytes() for path in keys.glob("*.key")}) == 8
    assert load_access(keys / ACCESS_FILE) == ACCESS


def find_roles(folder: Path) -> tuple[set[str], set[str]]:
    """Whose certificates are good for being called, and whose name hosts."""
    called, named = set(), set()
    for path in folder.glob("*.crt"):
        extensions = x509.load_pem_x509_certificate(path.read_bytes()).extensions
        kinds = {type(extension.value): extension.value for extension in extensions}
        if path.stem == "authority":
            continue
        assert ExtendedKeyUsageOID.CLIENT_AUTH in kinds[x509.ExtendedKeyUsage]
        if ExtendedKeyUsageOID.SERVER_AUTH in kinds[x509.ExtendedKeyUsage]:
            called.add(path.stem)
        if hosts := kinds.get(x509.SubjectAlternativeName):
            named.add(path.stem)
            assert hosts.get_values_for_type(x509.DNSName) == ["localhost", "grid-a.example"]
            assert "192.0.2.7" in map(str, hosts.get_values_for_type(x509.IPAddress))
    return called, named


def test_nobody_who_does_not_listen_has_a_certificate_for_being_called(keys: Path, tmp_path: Path):
    assert find_roles(keys) == ({"router"}, {"router"})
    create_keys(tmp_path / "direct", ACCESS, days=10, hosts=["grid-a.example", "192.0.2.7"], direct=True)
    assert find_roles(tmp_path / "direct") == ({"area1", "area2"}, {"area1", "area2"})


def test_nobody_is_called_at_the_host_of_another(tmp_path: Path):
    hosts = ["both.example", "area1=a.example", "area2=192.0.2.7"]
    create_keys(tmp_path / "keys", ACCESS, days=10, hosts=hosts, direct=True)
    for name, own in (("area1", ["both.example", "a.example"]), ("area2", ["both.example", "192.0.2.7"])):
        certificate = x509.load_pem_x509_certificate((tmp_path / "keys" / f"{name}.crt").read_bytes())
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        assert [str(entry.value) for entry in names][len(HERE) :] == own


def test_keys_for_areas_that_do_not_listen_are_rejected_where_they_do(keys: Path):
    with pytest.raises(InvalidInputError, match=r"area2.crt: is for a process that only calls others"):
        check_keys(keys, ACCESS, direct=True)
    with pytest.raises(InvalidInputError, match=r"make keys for this scenario with `dsse keys create SCENARIO`"):
        load_keys(keys, "area1", listens=True)


@pytest.mark.parametrize("umask", [0o000, 0o022, 0o777])
def test_nobody_else_may_read_a_private_key_whatever_the_umask(tmp_path: Path, umask: int):
    (tmp_path / "there").mkdir(mode=0o777)
    before = os.umask(umask)
    try:
        create_keys(tmp_path / "new" / "keys", ACCESS, days=10)
        create_keys(tmp_path / "there", ACCESS, days=10)
    finally:
        os.umask(before)
    for folder in (tmp_path / "new" / "keys", tmp_path / "there"):
        assert modes_of([folder]) == {0o700}
        assert modes_of(folder.glob("*.key")) == {0o600}
        assert modes_of(path for path in folder.iterdir() if path.suffix != ".key") == {0o644}
    assert modes_of([tmp_path / "new"]) == {0o700}


def modes_of(paths: Iterable[Path]) -> set[int]:
    return {stat.S_IMODE(path.stat().st_mode) for path in paths}


@pytest.mark.parametrize("name", ["authority.crt", "area1.crt", "access.toml"])
def test_a_file_that_anybody_may_change_is_rejected(keys: Path, name: str):
    (keys / name).chmod(0o666)
    assert f"all users of this host may change this file; chmod o-w {keys / name}" in problems_of(keys)


def test_whose_name_is_revoked_is_reported_at_the_start(keys: Path):
    save_access(keys / ACCESS_FILE, replace(ACCESS, revoked=("area1",)))
    assert "revoked: names 'area1', and this process would be 'area1'" in problems_of(keys)
    with pytest.raises(InvalidInputError, match="revoked: area1 is denied everything"):
        check_keys(keys, ACCESS)


def test_rules_are_applied_to_the_run_that_is_asked_for(keys: Path):
    loaded = load_keys(keys, "area1", "trial")
    assert loaded is not None
    assert loaded.access == replace(ACCESS, run="trial")
    assert loaded.load_anew() == loaded


def test_keys_are_never_overwritten(keys: Path):
    before = {path: path.read_bytes() for path in keys.iterdir()}
    with pytest.raises(InvalidInputError, match="is not empty; keys are never overwritten"):
        create_keys(keys, ACCESS, days=10)
    assert {path: path.read_bytes() for path in keys.iterdir()} == before


def test_the_rules_of_a_scenario_name_its_neighbours():
    access = access_of(load_scenario("ieee33").partition, "run")
    assert access.neighbours == {"area1": ("area2", "area3"), "area2": ("area1",), "area3": ("area1",)}


def test_a_name_that_fits_into_no_certificate_is_rejected(tmp_path: Path):
    with pytest.raises(InvalidInputError, match="longer than the 64 letters"):
        create_keys(tmp_path / "keys", Access("run", {"a" * 65: ()}), days=1)
    with pytest.raises(InvalidInputError, match="would be those of the authority"):
        create_keys(tmp_path / "keys", Access("run", {"authority": ()}), days=1)


def test_the_rules_of_a_scenario_name_its_gateways():
    partition = load_scenario("ieee33").partition
    with_plant = ReadingRules()
    assert access_of(partition, "run", load_scenario("ieee33").reading_rules).gateways == {}
    by_area = {
        "area1": replace(with_plant, gateways={"plant": "all", "north": ("vm@1",)}),
        "area2": replace(with_plant, gateways={"plant": "all", "north": "all", "south": "all"}),
        "area3": with_plant,
    }
    assert access_of(partition, "run", by_area).gateways == {"north": ("area1", "area2"), "south": ("area2",)}
    live = {area: ReadingRules(gateways={"north": "all"}) for area in by_area}
    assert access_of(partition, "run", live).gateways == {"north": ("area1", "area2", "area3"), "plant": ()}
    anybody = {area: ReadingRules(gateways={ANYBODY: "all"}) for area in by_area}
    assert access_of(partition, "run", anybody).gateways == {}


@pytest.mark.parametrize("role", ["plant", "operator", "watcher", "gateway-north"])
def test_no_area_gets_the_certificate_of_another_role(tmp_path: Path, role: str):
    access = Access("run", {role: ()}, gateways={"north": (role,)})
    with pytest.raises(InvalidInputError, match=f"no area can be called '{role}', as another process is"):
        create_keys(tmp_path / "keys", access, days=1)


def test_every_gateway_gets_a_certificate_for_calling_only(tmp_path: Path):
    access = replace(ACCESS, gateways={"north": ("area1",), "plant": ("area2",)})
    create_keys(tmp_path / "keys", access, days=1, hosts=["grid-a.example", "192.0.2.7"])
    keys = load_keys(tmp_path / "keys", "gateway-north")
    assert keys is not None
    assert keys.access == access
    called, _ = find_roles(tmp_path / "keys")
    assert called == {"router"}
    assert sorted(path.stem for path in (tmp_path / "keys").glob("gateway-*.key")) == ["gateway-north"]
    check_keys(tmp_path / "keys", access)
    with pytest.raises(InvalidInputError, match="gateway north sends readings to area1 there, to area2 in the scen"):
        check_keys(tmp_path / "keys", replace(access, gateways={"north": ("area2",), "plant": ("area2",)}))


def test_a_run_needs_no_keys_of_who_watches_and_operates_it(keys: Path):
    for name in ("operator", "watcher"):
        (keys / f"{name}.key").unlink()
    check_keys(keys, ACCESS)


def test_missing_files_are_named_with_how_to_get_them(tmp_path: Path):
    text = problems_of(tmp_path / "nowhere")
    assert "3 problems" in text
    for name in ("authority.crt", "area1.crt", "area1.key"):
        assert f"{name}: is missing; make it with `dsse keys create SCENARIO`" in text


def test_an_expired_certificate_is_named_with_its_date(tmp_path: Path):
    create_keys(tmp_path, ACCESS, days=-0.001)
    text = problems_of(tmp_path)
    assert f"{tmp_path / 'area1.crt'}: expired at {datetime.datetime.now(datetime.UTC):%Y-}" in text
    assert f"{tmp_path / 'authority.crt'}: expired" in text


def test_a_certificate_of_another_area_is_distinguished_from_ones_own(keys: Path):
    (keys / "area1.crt").write_bytes((keys / "area2.crt").read_bytes())
    text = problems_of(keys)
    assert "area1.crt: is the certificate of 'area2', and 'area1' is needed" in text
    assert "area1.key: does not belong to" in text


def test_a_certificate_of_another_authority_is_distinguished_from_ones_own(keys: Path, tmp_path: Path):
    create_keys(tmp_path / "others", ACCESS, days=10)
    (keys / "authority.crt").write_bytes((tmp_path / "others" / "authority.crt").read_bytes())
    assert "area1.crt: was issued by 'CN=authority of grid', not by the authority in" in problems_of(keys)


@pytest.mark.parametrize("name", ["area1.crt", "authority.crt"])
def test_a_file_that_is_no_certificate_is_named(keys: Path, name: str):
    (keys / name).write_text("hello")
    assert f"{name}: holds no certificate in PEM" in problems_of(keys)


def test_a_file_that_is_no_key_is_named(keys: Path):
    (keys / "area1.key").write_bytes(b"\xff\x00")
    assert "area1.key: holds no private key in PEM" in problems_of(keys)


def test_a_key_that_cannot_be_read_is_named(keys: Path):
    credentials_in(keys, "area1").key.unlink()
    (keys / "area1.key").mkdir(mode=0o700)
    assert "area1.key: cannot be read: is a folder" in problems_of(keys)


@pytest.mark.parametrize("mode", [0o640, 0o620, 0o604, 0o602])
def test_a_key_that_others_than_its_owner_may_read_or_change_is_rejected(keys: Path, mode: int):
    (keys / "area1.key").chmod(mode)
    assert f"chmod go-rwx {keys / 'area1.key'}" in problems_of(keys)


def test_keys_for_other_areas_are_rejected(keys: Path):
    with pytest.raises(InvalidInputError) as caught:
        check_keys(keys, Access("grid", {"area1": (), "area2": ()}))
    assert "area area1 has neighbours area2 there, none in the scenario" in str(caught.value)


def test_dsse_keys_create_makes_a_folder_for_each_process_with_all_that_it_needs(tmp_path: Path, capsys):
    out = tmp_path / "keys"
    command = ["keys", "create", "industrial13", "--out", str(out), "--days", "3", "--run", "trial"]
    assert run_command(command) == 0
    output = capsys.readouterr().out
    names = ("router", "plant", "coordinator", "operator", "watcher", "area1", "area2")
    assert f"{out}: a folder for each of {', '.join(names)}, valid for 3 days" in output
    assert f"{out / 'authority'} stays away from all" in output
    assert output.splitlines()[-1] == f"next: dsse run industrial13 --keys {out}"
    check_keys(out, Access("trial", {"area1": ("area2",), "area2": ("area1",)}))
    assert {folder.name for folder in out.iterdir()} == {*names, "authority"}
    assert modes_of(out.iterdir()) == {0o700}
    assert modes_of(out.rglob("*.key")) == {0o600}
    assert [path.parent.name for path in out.rglob("authority.key")] == ["authority"]
    for name in names:
        host = tmp_path / f"host of {name}"
        shutil.copytree(out / name, host / name)
        for folder in (host, host / name):
            keys = load_keys(folder, name, listens=name == "router")
            assert keys is not None
            assert keys.access.run == "trial"
    save_access(out / "area1" / ACCESS_FILE, replace(ACCESS, run="trial", revoked=("area2",)))
    with pytest.raises(InvalidInputError, match=r"area1.access.toml(?s:.*)revoked: area2 is denied everything"):
        check_keys(out, Access("trial", {"area1": ("area2",), "area2": ("area1",)}))
    assert run_command(command) == 2
    assert "is not empty; keys are never overwritten: choose a new folder" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--days", "0"], "--days"),
        (["--run", "a/b"], "may only contain a-z, 0-9, _ and -"),
        (["--host", "händler.example"], "host 'händler.example' is neither a name nor an address"),
        (["--host", "a.example:7447"], "host 'a.example:7447' is neither a name nor an address; without port"),
        (["--host", "tls/192.0.2.7"], "is neither a name nor an address"),
        (["--host", "192.0.2.777"], "is neither a name nor an address"),
        (["--host", "area9=a.example"], "'area9' does not listen; the processes that listen are router"),
        (["--host", "router=a.example:1"], "host 'a.example:1' is neither a name nor an address"),
        (["--host", ""], "is neither a name nor an address"),
        (["--host", "a" * 64 + ".example"], "is neither a name nor an address"),
        (["--out", "/dev/null/keys"], "cannot be made: a file is in its way"),
    ],
)
def test_dsse_keys_create_rejects_what_cannot_be(tmp_path: Path, capsys, options: list[str], expected: str):
    assert run_command(["keys", "create", "industrial13", "--out", str(tmp_path / "keys"), *options]) == 2
    assert expected in capsys.readouterr().err
