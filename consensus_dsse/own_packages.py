"""Check of the packages of consensus-dsse: others may have the same names, and Python takes the first that it finds."""

from __future__ import annotations

import os
from importlib.machinery import ModuleSpec, PathFinder

PACKAGES = ("agents", "coordinator", "dsse_core", "scenarios")
MARK = b"Part of consensus-dsse."  # in the docstring of each of ours
ROOT = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))


class ForeignPackageError(ImportError):
    """Another distribution or folder stands in the place of a package of consensus-dsse."""


def check_own_packages() -> None:
    """Checks that Python imports our packages under their names.

    Raises:
        ForeignPackageError: Python would import others, or others have overwritten ours; names them and the cure.
    """
    problems = [problem for name in PACKAGES if (problem := _find_problem(name))]
    if problems:
        raise ForeignPackageError("; ".join(problems))


def _find_problem(name: str) -> str | None:
    spec = PathFinder.find_spec(name)
    if spec is None:
        return f"the package {name!r} is missing; install consensus-dsse again: `{_reinstall_command()}`"
    if spec.origin is not None and _is_ours(spec.origin):
        return None
    place = _place_of(spec)
    owner = _distribution_of(name)
    if owner is None:
        return (
            f"{place} stands in the place of the package {name!r} of consensus-dsse; rename it, or start Python in "
            "another folder"
        )
    return (
        f"{place}, of the distribution {owner}, stands in the place of the package {name!r} of consensus-dsse; install "
        f"consensus-dsse in an environment of its own, or `pip uninstall {owner}` and then "
        f"`{_reinstall_command()}`"
    )


def _reinstall_command() -> str:
    """The command that puts our packages in their places again, from where they came if that can be found out."""
    options = ("--force-reinstall", "--no-deps")
    spec = PathFinder.find_spec("dsse_core")
    if spec is None or spec.origin is None or not _is_ours(spec.origin):
        return " ".join(["pip install", *options, "consensus-dsse"])
    from dsse_core.files.installation import install_command

    return install_command("", *options)


def _is_ours(file: str) -> bool:
    try:
        with open(file, "rb") as text:
            return MARK in text.read(2000)
    except OSError:
        return False


def _place_of(spec: ModuleSpec) -> str:
    return spec.origin or ", ".join(spec.submodule_search_locations or ())


def _distribution_of(package: str) -> str | None:
    """Another distribution that contains ``package``, None if there is none."""
    from importlib.metadata import packages_distributions

    names = packages_distributions().get(package, [])
    return next((name for name in names if name != "consensus-dsse"), None)
