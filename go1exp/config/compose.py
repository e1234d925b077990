"""Composition of ``conf/`` outside an application, and what is wrong with an override, with the nearest names."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from go1exp.config import hydra_adapter
from go1exp.config.choices import FOLDERS, choice_files, config_folder, groups_of
from go1exp.config.schema.registry import ConfigError, nearest, unknown_name

VALUE_PER_JOINT = re.compile(
    r"(?P<add>\+{0,2})(?P<key>(effect\.[^.=]+|actuator(\.drive)*)\.(?!(drive|spread)=)[^.=@]+)=\s*[\[{]"
)
"""An override that writes a value per joint as a list or as a mapping."""


OPEN = re.compile(r"model\.tolerances[.=]")
"""An override of a mapping to which a user may add keys; the verb checks them."""


INSTEAD = {
    ("eval", "terrain"): "train_ground=true or protocol=terrain walks on uneven ground",
    ("eval", "rand"): "randomize=true randomises as in training",
}
"""What a verb has in place of a group of others."""


def as_hydra_takes_them(overrides: Sequence[str]) -> list[str]:
    """Return overrides in a form that Hydra accepts, where it is stricter than our documents.

    A value per joint may change its form: number, list or mapping. Hydra merges a mapping into what the file has, and
    refuses if that is a list, such as ``bound: [0.2, 0.2, 0.3]``. So such a value is removed first; a joint that the
    new mapping leaves out is without the effect. A tolerance may be given although the file names none (``++``).
    """
    accepted = []
    for override in overrides:
        if match := VALUE_PER_JOINT.match(override):
            # Two spellings of the key, since a sweep keeps only the last override of each.
            accepted += [f"{'++' if match['add'] else ''}{match['key']}=null", f"+{override.lstrip('+')}"]
        else:
            accepted.append(f"++{override}" if OPEN.match(override) else override)
    return accepted


def compose(
    name: str, overrides: Sequence[str] = (), folders: Sequence[Path] = (), *, resolve: bool = True
) -> dict[str, Any]:
    """Compose ``conf/<name>.yaml`` with command-line overrides outside a Hydra application.

    Args:
        name: of the verb.
        overrides: as on the command line.
        folders: the user's folders of further choices.
        resolve: replace interpolations by their values.
    """
    return hydra_adapter.composed(name, as_hydra_takes_them(overrides), folders, resolve)


def compose_checked(name: str, overrides: Sequence[str] = ()) -> dict[str, Any]:
    """Compose as ``compose`` does, with the command line's messages; raise ConfigError if an override does not fit."""
    try:
        return compose(name, overrides)
    except hydra_adapter.REFUSED as error:
        problem = composition_problem(error, name, overrides)
        if problem is None:
            raise
        raise ConfigError([problem]) from None


def composition_problem(
    error: Exception, name: str, overrides: Sequence[str], folders: Sequence[Path] = ()
) -> str | None:
    """Return why ``overrides`` of ``conf/<name>.yaml`` were refused, in one line; None if they were not.

    Options among the overrides, such as ``-m``, are left out.
    """
    overrides = [o for o in overrides if not o.startswith("-") and ("=" in o or o.startswith("~"))]
    why = hydra_adapter.refusal(error, name, as_hydra_takes_them(overrides), folders)
    if why is None:
        return None
    if why.kind == "choice":
        return _no_such_choice(why.subject, folders) or why.text
    if why.kind == "grammar":
        about = "a value with =, brackets or quotes takes quotes"
        return f"""{why.subject}: cannot be read as key=value; {about}, as in 'key="a=(b)"'"""
    if why.kind == "type":
        return f"{why.subject}: a group takes the name of one of its files, such as reward=paper"
    if why.kind == "other":
        return why.text
    key = why.subject
    given = next((o for o in overrides if o.lstrip("+~").split("=")[0].split("@")[0] == key), key)
    if why.kind == "present":
        plain = given.lstrip("+")
        return f"{given}: {key!r} exists already; leave out the plus: {plain!r}"
    return _no_such_key(key, given, name, overrides, folders)


def _no_such_choice(missing: str, folders: Sequence[Path]) -> str | None:
    """Name the choice that a group does not have, and the nearest ones; None if it is no group of ours."""
    group, _, choice = missing.partition("/")
    for ours in (g for g in FOLDERS if "/" in g and missing.startswith(f"{g}/")):
        group, choice = ours, missing.removeprefix(f"{ours}/")
    known = choice_files(group, [config_folder(), *folders])
    if known and not choice:
        return f"{group}=: a group takes the name of one of its files: {', '.join(sorted(known))}"
    return unknown_name(f"{group}={choice}", choice, known, f"choice of {group}") if known else None


def _no_such_key(key: str, given: str, name: str, overrides: Sequence[str], folders: Sequence[Path]) -> str:
    if "@" in key:
        return f"{given}: no such key {key!r}; a file with `override /...` begins with the line `# @package _global_`"
    if named := next((group for group, folder in FOLDERS.items() if folder == key), None):
        return f"{given}: no such key {key!r}; did you mean {given.replace(key, named, 1)!r}?"
    groups = [o for o in overrides if re.match(r"[a-z_]+=[a-z]", o) and o != given]
    try:
        known = [k for k in flat_keys(name, groups, folders) if k != key]
    except Exception:  # one of the others is wrong too
        known = [k for k in flat_keys(name) if k != key]
    parent, _, last = key.rpartition(".")
    if name == "train" and any(o.startswith("resume=") for o in overrides):  # whose keys are not those of the defaults
        beside = [k.rpartition(".")[2] for k in known if k.rpartition(".")[0] == parent]
        if not nearest(last, beside):
            return f"{given}: a resumed run keeps its configuration; start_from begins another run with its weights"
    group, _, inside = key.partition(".")
    choices = choice_files(group, [config_folder(), *folders]) if inside and group in groups_of(name) else {}
    if choices and not any(k.startswith(f"{group}.") for k in known):
        first = inside.partition(".")[0]
        chosen = first if first in choices else "NAME"
        return f"{given}: no such key {key!r}; no file of {group} is chosen, as {group}={chosen} does"
    ends = {k: k.rpartition(".")[2] for k in known} if parent else {}
    close = nearest(key, known) or [k for k, end in ends.items() if nearest(last, [end])]
    hint = f"did you mean {' or '.join(repr(c) for c in close[:3])}?" if close else "see --help"
    verbs = sorted(file.stem for file in config_folder().glob("*.yaml") if group in groups_of(file.stem))
    if verbs and name not in verbs:
        instead = INSTEAD.get((name, group), "see --help")
        hint = f"{group} is a group of {', '.join(verbs).replace('_', ' ')}; {instead}"
    term, _, parameter = key.rpartition(".")
    others = [k.rpartition(".")[2] for k in known if k.startswith(f"{term}.")]
    if term.count(".") == 1 and others and given[0] not in "+~" and not nearest(parameter, others):
        hint += f" A parameter of a term that its file leaves out takes a plus: '+{given}'"
    return f"{given}: no such key {key!r}; {hint}"


def key_values(container: object, path: str = "") -> dict[str, Any]:
    """Flatten nested mappings: every key path, with its value (a mapping's own path is there too, with None)."""
    if not isinstance(container, dict):
        return {path: container}
    flat: dict[str, Any] = {path: None} if path else {}
    for key, value in container.items():
        flat |= key_values(value, f"{path}.{key}" if path else str(key))
    return flat


def flat_keys(name: str, overrides: Sequence[str] = (), folders: Sequence[Path] = ()) -> list[str]:
    """Return every key path of ``conf/<name>.yaml`` composed with ``overrides``, groups included."""
    return list(key_values(compose(name, overrides, folders)))
