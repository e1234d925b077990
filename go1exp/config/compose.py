"""Hydra's side of the configuration: where it lies, its groups, composition outside an application."""

from __future__ import annotations

import os
import pickle
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any

from hydra import compose as hydra_compose
from hydra import version
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.hydra import Hydra
from hydra._internal.utils import create_config_search_path
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from go1exp.config.choices import FOLDERS, choice_files, config_folder, groups_of
from go1exp.config.schema.registry import ConfigError, nearest, unknown_name
from go1exp.config.source import seen_by

GRAMMAR = "See https://hydra.cc/docs/1.2/advanced/override_grammar/basic for details"
"""What Hydra ends its remarks on a value with."""


def as_container(config: DictConfig) -> dict[str, Any]:
    """Resolve interpolations and return plain dicts and lists."""
    container = OmegaConf.to_container(config, resolve=True)
    assert isinstance(container, dict)
    return {str(k): v for k, v in container.items()}


VALUE_PER_JOINT = re.compile(
    r"(?P<add>\+{0,2})(?P<key>(effect\.[^.=]+|actuator(\.drive)*)\.(?!(drive|spread)=)[^.=@]+)=\s*[\[{]"
)
"""An override that writes a value per joint as a list or as a mapping."""


OPEN = re.compile(r"model\.tolerances[.=]")
"""An override of a mapping to which a user may add keys; the verb checks them."""


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


@contextmanager
def hydra_for(name: str, folders: Sequence[Path] = ()) -> Iterator[None]:
    """Set Hydra up for what ``conf/<name>.yaml`` may choose from, with a user's ``folders`` of further choices."""
    GlobalHydra.instance().clear()
    with seen_by(name, folders):
        version.setbase("1.3")
        # hydra.initialize does this too, but first looks through the call stack for a folder that we do not have
        Hydra.create_main_hydra2("go1exp", create_config_search_path(None))
        try:
            yield
        finally:
            GlobalHydra.instance().clear()


def compose(name: str, overrides: Sequence[str] = (), folders: Sequence[Path] = ()) -> dict[str, Any]:
    """Compose ``conf/<name>.yaml`` with command-line overrides outside a Hydra application."""
    return as_container(compose_unresolved(name, overrides, folders))


def compose_unresolved(name: str, overrides: Sequence[str] = (), folders: Sequence[Path] = ()) -> DictConfig:
    """Compose as ``compose`` does, and leave interpolations as they are written."""
    words = as_hydra_takes_them(overrides)
    with hydra_for(name, folders):
        config = _on_kept_choices(name, words, tuple(folders))
        return hydra_compose(name, words) if config is None else config


def _on_kept_choices(name: str, overrides: Sequence[str], folders: tuple[Path, ...]) -> DictConfig | None:
    """Compose the choices of groups once, and set the other values on a copy: a tenth of the time.

    Hydra does the same in this order: it merges the chosen files, then sets values. Returns None where Hydra must do
    the whole: for its own settings (``hydra.*``), for a user's file (``effect=mine.yaml``), for the rare forms of an
    override, and for what Hydra refuses, so that the refusal is that of a whole composition.
    """
    try:
        parsed = OverridesParser.create().parse_overrides(list(overrides))
        if any(o.is_sweep_override() or o.package or re.match(r"hydra(\.|/|$)", o.key_or_group) for o in parsed):
            return None
        groups = GlobalHydra.instance().config_loader().repository.group_exists  # type: ignore[attr-defined]
        choices = [o for o in parsed if groups(o.key_or_group)]
        if any(isinstance(o.value(), dict) or _is_users_file(o) for o in choices):
            return None
        state = tuple(_stamps(folder) for folder in (config_folder(), *folders))
        config: DictConfig = pickle.loads(_chosen(name, tuple(str(o.input_line) for o in choices), folders, state))
        ConfigLoaderImpl._apply_overrides_to_config([o for o in parsed if not groups(o.key_or_group)], config)
    except (HydraException, OmegaConfBaseException):
        return None
    return config


def _is_users_file(choice: Override) -> bool:
    """Return whether a choice was made of a file outside the folders; Hydra keeps those in a store of its own."""
    stored, value = ConfigStore.instance().repo.get(choice.key_or_group, {}), choice.value()
    return any(f"{name}.yaml" in stored for name in (value if isinstance(value, list) else [value]))


@lru_cache(maxsize=64)
def _chosen(name: str, choices: tuple[str, ...], folders: tuple[Path, ...], state: tuple[Any, ...]) -> bytes:
    """Return ``conf/<name>.yaml`` with choices of groups, pickled; ``state`` is that of the files it may be made of."""
    return pickle.dumps(hydra_compose(name, list(choices)))


def _stamps(folder: str | Path) -> tuple[tuple[str, int, int], ...]:
    """Return name, time of change and size of each file below a folder."""
    stamps: list[tuple[str, int, int]] = []
    with os.scandir(folder) as entries:
        for entry in entries:
            if entry.is_dir():
                stamps += _stamps(entry.path)
            else:
                stat = entry.stat()
                stamps.append((entry.path, stat.st_mtime_ns, stat.st_size))
    return tuple(sorted(stamps))


def compose_checked(name: str, overrides: Sequence[str] = ()) -> dict[str, Any]:
    """Compose as ``compose`` does, with the command line's words for what is wrong.

    Raises:
        ConfigError: if an override does not fit.
    """
    try:
        return compose(name, overrides)
    except (HydraException, OmegaConfBaseException, ValueError) as error:
        problem = composition_problem(error, name, overrides)
        if problem is None:
            raise
        raise ConfigError([problem]) from None


def composition_problem(
    error: Exception, name: str, overrides: Sequence[str], folders: Sequence[Path] = ()
) -> str | None:
    """Return in words why Hydra refused ``overrides`` of ``conf/<name>.yaml``; None if that is not what happened."""
    if isinstance(error, MissingConfigException):
        missing = error.missing_cfg_file or ""
        ours = next((group for group in FOLDERS if "/" in group and missing.startswith(f"{group}/")), "")
        group, _, choice = (ours, "", missing.removeprefix(f"{ours}/")) if ours else missing.partition("/")
        known = choice_files(group, [config_folder(), *folders])
        if known and not choice:
            return f"{group}=: a group takes the name of one of its files: {', '.join(sorted(known))}"
        if known:
            return unknown_name(f"{group}={choice}", choice, known, f"choice of {group}")
        return str(error).split("\n")[0]
    if isinstance(error, OverrideParseException):
        about = "a value with =, brackets or quotes takes quotes"
        return f"""{error.override}: cannot be read as key=value; {about}, as in 'key="a=(b)"'"""
    if isinstance(error, HydraException | OmegaConfBaseException):
        return _refused_override(error, name, overrides, folders)
    if isinstance(error, ValueError) and "override must be a string" in str(error):
        files = {group: choice_files(group, [config_folder(), *folders]) for group in groups_of(name)}
        pairs = ((override, *override.partition("=")[::2]) for override in overrides)
        bad = next((text for text, group, choice in pairs if group in files and choice not in files[group]), "a group")
        return f"{bad}: a group takes the name of one of its files, such as reward=paper"
    return None


def _refused_override(error: Exception, name: str, overrides: Sequence[str], folders: Sequence[Path]) -> str:
    """Name the key that Hydra refused, the value, and the nearest keys that exist."""
    match = re.search(r"Could not (?:override|append to config|delete from config)[^']*'([^']+)'", str(error))
    if not match:
        cause = str(error.__cause__ or error).replace(GRAMMAR, "")
        return " ".join(line.strip() for line in cause.splitlines() if line.strip())
    key = match.group(1)
    given = next((o for o in overrides if o.lstrip("+~").split("=")[0].split("@")[0] == key), key)
    if "Could not append to config" in str(error):
        plain = given.lstrip("+")
        return f"{given}: {key!r} exists already; leave out the plus: {plain!r}"
    if named := next((group for group, folder in FOLDERS.items() if folder == key), None):
        return f"{given}: no such key {key!r}; did you mean {given.replace(key, named, 1)!r}?"
    groups = [o for o in overrides if re.match(r"[a-z_]+=[a-z]", o) and o != given]
    try:
        known = [k for k in flat_keys(name, groups, folders) if k != key]
    except Exception:  # one of the others is wrong too
        known = [k for k in flat_keys(name) if k != key]
    close = nearest(key, known) or nearest(key.rsplit(".", 1)[-1], known)
    hint = f"did you mean {' or '.join(repr(c) for c in close)}?" if close else "see --help"
    term, _, parameter = key.rpartition(".")
    others = [k.rpartition(".")[2] for k in known if k.startswith(f"{term}.")]
    if term.count(".") == 1 and others and given[0] not in "+~" and not nearest(parameter, others):
        hint += f" A parameter of a term that its file leaves out takes a plus: '+{given}'"
    return f"{given}: no such key {key!r}; {hint}"


def key_values(container: Any, path: str = "") -> dict[str, Any]:
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
