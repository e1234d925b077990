"""``go1exp VERB --help``: what a verb does, its groups, every setting in one line, examples; and ``go1exp list``.

Nothing is written twice: the settings' lines come from the docstrings of their classes, values from ``conf/``, what a
verb does and its examples from ``hydra.help`` in ``conf/VERB.yaml``.
"""

from __future__ import annotations

import shutil
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from go1exp.cli.app import MEANING, App, app_of, parse
from go1exp.cli.hydra_main import choices_from_files
from go1exp.cli.verbs import LISTS, POSITIONAL, SUBVERBS, parted
from go1exp.config.choices import about, choice_files, config_folder, given_folders, groups_in, groups_of, load
from go1exp.config.compose import compose
from go1exp.config.hydra_adapter import shown_folders
from go1exp.config.schema import plugins, registry
from go1exp.config.schema import settings as schema
from go1exp.config.schema.registry import ConfigError, members, nearest, unknown_name

KEY_WIDTH = 34  # columns of ``key=value`` before the text beside it

WITHOUT = {"experiment": "", "study": "", "terrain": "; without it flat, or that of training with train_ground=true"}
"""Group without a default choice -> remark in its line; all others then keep the choice of training."""

WITHOUT_IN = {
    ("gap", "contact"): "; without it that which the recordings name, or soft",
    ("record", "contact"): "; without it soft, and of a policy that of training",
}
"""The same for a group of one verb."""


def show(verb: str, arguments: Sequence[str]) -> None:
    """Print the help of a verb, or of a group named among the arguments; raise ConfigError for a word without help."""
    words, title = parted(arguments)[2], f"go1exp {verb.replace('_', ' ')}"
    if subverb := next((word for word in words if word in SUBVERBS.get(verb, ())), None):
        show(f"{verb}_{subverb}", [word for word in arguments if word != subverb])
        return
    folders = given_folders(arguments)
    groups = groups_of(verb)
    container = _composed(verb, arguments, folders[1:])
    keys = leaves(container)
    sections = {key.rpartition(".")[0] for key in keys}
    strange = [word for word in words if word not in {*groups, *keys, *sections}]
    positional = POSITIONAL.get(verb, ())  # words for themselves, as the file in ``go1exp deploy walk.zip --help``
    if len(strange) > len(positional) and not {*positional} & {*LISTS}:
        close = " or ".join(repr(name) for name in nearest(strange[-1], [*groups, *keys]))
        hint = f"did you mean {close}?" if close else f"{title} --help lists them"
        raise ConfigError([f"no group or key {strange[-1]!r}; {hint}"])
    named = next((group for word in words if (group := word.partition(".")[0]) in groups), None)
    print("\n".join(_group_page(title, named, groups, container, folders) if named else _page(verb, title, container)))


def _composed(verb: str, arguments: Sequence[str], folders: Sequence[Path]) -> dict[str, Any]:
    """Compose with the overrides among the arguments, or without them where they are wrong: help is for that too."""
    overrides = [word for word in arguments if "=" in word and not word.startswith("-")]
    try:
        return compose(verb, choices_from_files(overrides, verb), folders)
    except Exception:
        return compose(verb)


def _page(verb: str, title: str, container: Mapping[str, object]) -> list[str]:
    hydra_help = load(config_folder() / f"{verb}.yaml")["hydra"]["help"]
    groups = groups_of(verb)
    usage = f"{title} {'[group=choice ...] ' if groups else ''}[key=value ...]"
    lines = [*hydra_help["header"].splitlines(), "", f"Usage: {usage}", ""]
    if groups:
        lines.append("Groups (group=choice, or group=FILE.yaml; * is what is chosen otherwise):")
        for group, default in groups.items():
            lines += _beside(group, _choices(verb, group, default), 14)
        lines += ["", f"  {title} --help {next(iter(groups))}      choices and keys of one group", ""]
    texts = texts_of(verb)
    lines.append("Settings (key=value; these are the values without it):")
    for key, value in leaves({k: v for k, v in container.items() if k not in groups}).items():
        shown, remark = ("", "(required) ") if value == "???" else (_plain(value), "")
        lines += _beside(f"{key}={shown}", remark + texts.get(key, ""))
    return [*lines, "", *hydra_help["footer"].rstrip().splitlines()]


def _group_page(
    title: str, group: str, groups: Mapping[str, str | None], container: Mapping[str, object], folders: Sequence[Path]
) -> list[str]:
    lines = [f"{title}: group {group}", "", f"Choices ({group}=NAME, or {group}=FILE.yaml; * without it):"]
    for name, file in choice_files(group, folders).items():
        lines += _beside(name + ("*" if name == groups[group] else ""), about(file))
    settings = container.get(group)
    if isinstance(settings, dict) and settings:
        lines += ["", "Keys (key=value):"]
        texts = _texts_of_group(group, settings)
        for key, value in settings.items():
            path = f"{group}.{key}"
            if isinstance(value, dict) and path in texts:  # a term: its line, then its parameters
                lines += _beside(path, texts[path])
                lines += [f"    {name}={_plain(v)}" for name, v in leaves(value, f"{path}.").items()]
            else:
                for name, v in leaves({path: value}).items():
                    lines += _beside(f"{name}={_plain(v)}", texts.get(name, ""))
    return lines + _slots(group)


def _slots(group: str) -> list[str]:
    """Explain the keys that every term of a group may have beside its own parameters."""
    from go1exp.config.schema.training import Ramp
    from go1exp.sim.task import MANY_TERMS

    slots = MANY_TERMS.get(group, Ramp if group == "schedule" else None)
    texts, item = (schema.attributes(slots) if slots else {}), "NAME" if slots is Ramp else "TERM"
    lines = [line for name, text in texts.items() for line in _beside(f"{group}.{item}.{name}", text)]
    return ["", *lines] if lines else []


def texts_of(verb: str) -> dict[str, str]:
    """Return what each setting of a verb means, by key path, groups left out."""
    if kind := app_of(verb).settings:
        return {**schema.lines(kind), plugins.KEY: MEANING}
    from go1exp.sim.task import SECTIONS, ProcessConfig

    sections = [name for name in SECTIONS if name not in groups_of(verb)]
    return schema.lines(ProcessConfig) | {
        k: v for name in sections for k, v in schema.lines(SECTIONS[name], f"{name}.").items()
    }


def _texts_of_group(group: str, settings: Mapping[str, Any]) -> dict[str, str]:
    """Return what the keys of a group mean: those of a section by its class, a term by its docstring."""
    from go1exp.config.schema.physics import BACKENDS
    from go1exp.evaluate.controller.settings import CONTROLLERS
    from go1exp.sim.task import ENGINES, ONE_TERM, REGISTERED_AS, SECTIONS

    by_name = {**dict.fromkeys(ENGINES, BACKENDS), "controller": CONTROLLERS}
    if group in by_name:
        return schema.lines(by_name[group][settings["name"]], f"{group}.")
    if group in SECTIONS:
        return schema.lines(SECTIONS[group], f"{group}.")
    if group == "protocol":
        import go1exp.evaluate.protocol.kinds  # noqa: F401  (registers them)
        from go1exp.evaluate.protocol.base import kinds

        return {k: v for key, kind in kinds(settings).items() for k, v in schema.lines(kind, f"{group}.{key}.").items()}
    terms = members(REGISTERED_AS.get(group, group))
    if group in ONE_TERM:
        return {f"{group}.term": terms[settings["term"]].doc}
    names = {key: value.get("term", key) if isinstance(value, dict) else key for key, value in settings.items()}
    return {f"{group}.{key}": terms[name].doc for key, name in names.items() if name in terms}


def _choices(verb: str, group: str, default: str | None) -> str:
    """Return the names of a group's choices in a line; those in folders as ``ablation/...``."""
    names = dict.fromkeys(
        n if "/" not in n else f"{n.split('/')[0]}/..." for n in choice_files(group, [config_folder()])
    )
    listed = ", ".join(name + ("*" if name == default else "") for name in names)
    if default:
        return listed
    return listed + WITHOUT_IN.get((verb, group), WITHOUT.get(group, "; without it that of training"))


def leaves(container: Mapping[str, object], path: str = "") -> dict[str, Any]:
    """Return the leaves by key path; an empty mapping is a leaf."""
    flat: dict[str, Any] = {}
    for key, value in container.items():
        flat |= leaves(value, f"{path}{key}.") if isinstance(value, dict) and value else {f"{path}{key}": value}
    return flat


def _plain(value: object) -> str:
    """Write a value as the command line takes it."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, list):
        return f"[{','.join(map(_plain, value))}]"
    return "{}" if value == {} else str(value)


def _beside(key: str, text: str, width: int = KEY_WIDTH) -> list[str]:
    available = max(60, min(120, shutil.get_terminal_size((120, 24)).columns)) - width - 4
    wrapped = textwrap.wrap(text.replace("``", "").replace("None", "null").rstrip("."), available) or [""]
    indent = " " * (width + 4)
    if len(key) > width:
        return [f"  {key}", *(f"{indent}{line}" for line in wrapped if line)]
    return [f"  {key:{width}}  {wrapped[0]}".rstrip(), *(f"{indent}{line}" for line in wrapped[1:])]


@schema.settings
class ListSettings:
    """``conf/list.yaml``.

    Attributes:
        what: terms, groups, or all.
        group: only this group, such as reward or rand.
    """

    what: Literal["all", "terms", "groups"]
    group: str | None


def _list(container: dict[str, object]) -> None:
    import go1exp.evaluate.protocol.kinds
    import go1exp.logs.excitations
    import go1exp.logs.importers
    import go1exp.logs.record.motions  # noqa: F401  (registers every member)

    plugins.installed()
    settings = parse(ListSettings, container)
    choices = _every_choice()
    known = sorted({*registry.groups(), *choices})
    wanted = settings.group
    if wanted is not None and wanted not in known:
        wanted = wanted.removesuffix("s")  # effects as well as effect
    if wanted is not None and wanted not in known:
        raise ConfigError([unknown_name("group", str(settings.group), known, "group")])
    for group in known:
        if wanted in (None, group):
            _print_group(group, choices.get(group, []), settings.what)


def _print_group(group: str, choices: list[tuple[str, str]], what: str) -> None:
    terms = members(group)
    print(group)
    if what != "terms":
        for name, about in choices:
            print(f"  {group}={name:26} {about}")
    if what != "groups":
        for entry in terms.values():
            source = plugins.origin(entry)
            print(f"  {entry.name:{len(group) + 27}} {entry.doc}{f'  [{source}]' if source else ''}")
            if entry.parameters:
                parameters = entry.parameters.values()
                texts = (p.name if p.default is p.empty else f"{p.name}={p.default!r}" for p in parameters)
                print(f"  {'':{len(group) + 27}}   {', '.join(texts)}")
    print()


def _every_choice() -> dict[str, list[tuple[str, str]]]:
    """Return the choices of each group with the first sentence of their file's comment, a user's own included."""
    folders = shown_folders()
    groups = dict.fromkeys(group for folder in folders for group in groups_in(folder))
    return {group: [(name, about(file)) for name, file in choice_files(group, folders).items()] for group in groups}


APP = App("list", _list, ListSettings)
