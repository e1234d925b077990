"""``go1exp list``."""

from __future__ import annotations

from typing import Any, Literal

from go1exp.cli.app import App, parse
from go1exp.config.choices import about, choice_files, groups_in
from go1exp.config.hydra_adapter import shown_folders
from go1exp.config.schema import settings as schema


@schema.settings
class ListSettings:
    """``conf/list.yaml``.

    Attributes:
        what: terms, groups, or all.
        group: only this group, such as reward or rand.
    """

    what: Literal["all", "terms", "groups"]
    group: str | None


def _task(container: dict[str, Any]) -> None:
    import go1exp.evaluate.protocol.kinds
    import go1exp.logs.excitations
    import go1exp.logs.importers
    import go1exp.logs.record.motions  # noqa: F401  (registers every member)
    from go1exp.config.schema import plugins, registry

    plugins.installed()
    settings = parse(ListSettings, container)
    choices = _choices()
    known = sorted({*registry.groups(), *choices})
    wanted = settings.group
    if wanted is not None and wanted not in known:
        wanted = wanted.removesuffix("s")  # effects as well as effect
    if wanted is not None and wanted not in known:
        raise registry.ConfigError([registry.unknown_name("group", str(settings.group), known, "group")])
    for group in known:
        if wanted in (None, group):
            _print_group(group, choices.get(group, []), settings.what)


def _print_group(group: str, choices: list[tuple[str, str]], what: str) -> None:
    from go1exp.config.schema import plugins, registry

    terms = registry.members(group)
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


def _choices() -> dict[str, list[tuple[str, str]]]:
    """Return the choices of each group with the first sentence of their file's comment, a user's own included."""
    folders = shown_folders()
    groups = dict.fromkeys(group for folder in folders for group in groups_in(folder))
    return {group: [(name, about(file)) for name, file in choice_files(group, folders).items()] for group in groups}


APP = App("list", _task, ListSettings)
