"""What every term promises, as checks: for the tests of this package, and for those of yours.

In a test file beside your terms::

    from go1exp.extend.testing import check_plugin

    def test_my_terms() -> None:
        check_plugin("my_terms.py")
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import go1exp.extend  # noqa: F401  (registers every term)
from go1exp.config.schema import plugins
from go1exp.config.schema.registry import Entry
from go1exp.extend.testing import actuators, randomness, snapshots, traces
from go1exp.extend.testing.description import check_description

CHECKS = {
    "reward": snapshots.check_reward,
    "observation": snapshots.check_observation,
    "termination": snapshots.check_termination,
    "rand": randomness.check_randomization,
    "command": randomness.check_command,
    "event": randomness.check_event,
    "curriculum": randomness.check_curriculum,
    "actuator": actuators.check_actuator,
    "effect": actuators.check_effect,
    "excitation": randomness.check_excitation,
    "measure": traces.check_measure,
}
"""What a member of a group promises beyond its description; an importer's promises need one of its files."""


def check_term(entry: Entry, parameters: Mapping[str, object] | None = None, *, exact: bool = False) -> None:
    """Check what a registered term promises.

    Args:
        entry: the term.
        parameters: as a configuration gives them; needed if one of them has no default.
        exact: a robot gets the same alone and in a batch to the last bit, and not only to rounding. Holds for what is
            computed element by element; a matrix product may round differently in a batch of another size.

    Raises:
        AssertionError: naming the term and the promise that it breaks.
        go1exp.config.schema.registry.ConfigError: if the parameters do not fit.
    """
    check_description(entry)
    if entry.group in CHECKS and not entry.traits.get("closed_loop"):
        CHECKS[entry.group](entry, dict(parameters or {}), exact)


def check_terms(
    entries: Iterable[Entry], parameters: Mapping[str, Mapping[str, object]] | None = None, *, exact: bool = False
) -> list[str]:
    """Check terms; return what was checked, as ``group.name``.

    Args:
        entries: the terms.
        parameters: of each term that cannot do without, by ``group.name``.
        exact: as for ``check_term``.

    Raises:
        AssertionError: with one line for each term that breaks a promise.
    """
    checked, broken = [], []
    for entry in entries:
        name = f"{entry.group}.{entry.name}"
        try:
            check_term(entry, (parameters or {}).get(name), exact=exact)
        except Exception as error:  # whatever a user's term may raise
            text = str(error).strip() or type(error).__name__
            broken.append(text if isinstance(error, AssertionError) else f"{name}: {type(error).__name__}: {text}")
        checked.append(name)
    if broken:
        raise AssertionError("\n".join(broken))
    return checked


def check_plugin(
    name: str, parameters: Mapping[str, Mapping[str, object]] | None = None, *, exact: bool = False
) -> list[str]:
    """Load a file or package and check every term that it registers; arguments and errors as ``check_terms``'s.

    Raises:
        go1exp.config.schema.registry.ConfigError: if it is missing, fails, or registers nothing.
    """
    (plugin,) = [p for p in plugins.load(name) if p.name == name]
    return check_terms(plugin.entries, parameters, exact=exact)
