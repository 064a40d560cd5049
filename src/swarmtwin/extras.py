"""The parts that swarmtwin is installed in: what each extra of `pyproject.toml` asks for, and what is not there of it.

`pip install swarmtwin` brings what every command needs, `pip install 'swarmtwin[deploy]'` what drives robots,
`'swarmtwin[train]'` what learns. What an extra asks for stands in the metadata of the installed package alone.
"""

from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, requires, version
from typing import TYPE_CHECKING, Literal

from swarmtwin.errors import UserError

if TYPE_CHECKING:
    from packaging.requirements import Requirement

Extra = Literal["base", "deploy", "tracking", "train", "studies", "slurm", "ray", "postgresql", "s3", "services", "dev"]
"""A part; `base` is what is always installed."""


def requirements(extra: Extra) -> tuple["Requirement", ...]:
    """Return what an extra asks for beyond `base`, and what the extras that it is made of ask for.

    Empty where swarmtwin is imported from its sources without being installed.
    """
    found = {str(one): one for one in _requirements(extra)}
    return tuple(found.values())


def missing_packages(extra: Extra) -> dict[str, str | None]:
    """Return the packages of an extra that are not here, or in a version that swarmtwin was not tested with.

    Returns:
        What is installed of each, by the package's name: a version, or None.
    """
    missing: dict[str, str | None] = {}
    for requirement in requirements(extra):
        found = _installed(requirement.name)
        if found is None or not requirement.specifier.contains(found, prereleases=True):
            missing[requirement.name] = found
    return missing


def require_extra(extra: Extra, what: str) -> None:
    """Check that all packages of an extra are installed, in whichever version.

    Args:
        extra: which.
        what: needs them, in a message.

    Raises:
        UserError: one is not.
    """
    absent = sorted(name for name, found in missing_packages(extra).items() if found is None)
    if absent:
        named = ", ".join([*absent[:3], *(["..."] if absent[3:] else [])])
        raise UserError(f"{what} needs what is not installed here, {named}: {install_command(extra)}")


def install_command(extra: Extra) -> str:
    """Return the command that installs an extra."""
    return "pip install swarmtwin" if extra == "base" else f"pip install 'swarmtwin[{extra}]'"


def _requirements(extra: str) -> Iterator["Requirement"]:
    from packaging.requirements import Requirement  # not for those who only look up which commands there are

    for requirement in map(Requirement, _stated()):
        asked = _belongs_to(requirement, "") if extra == "base" else _belongs_to(requirement, extra)
        if not asked:
            continue
        if requirement.name == "swarmtwin":
            for part in sorted(requirement.extras):
                yield from _requirements(part)
        else:
            yield requirement


def _belongs_to(requirement: "Requirement", extra: str) -> bool:
    """Say whether a requirement is the extra's, and not one of `base`, which every extra would find again."""
    if requirement.marker is None:
        return not extra
    return requirement.marker.evaluate({"extra": extra}) and (
        not extra or not requirement.marker.evaluate({"extra": ""})
    )


def _stated() -> list[str]:
    try:
        return requires("swarmtwin") or []
    except PackageNotFoundError:
        return []


def _installed(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None
