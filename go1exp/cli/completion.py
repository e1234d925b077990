"""Tab completion, answered at every key press: it reads file names and YAML, and imports neither Hydra nor torch.

A shell asks ``go1exp -sc query=SHELL`` with the line in ``COMP_LINE`` and the place of the cursor in ``COMP_POINT``.
The answer is one completion a line; nothing but that is ever written to the terminal.
"""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, get_args

from go1exp.base.errors import REFUSED, Expected
from go1exp.base.paths import data_root
from go1exp.base.wording import Start
from go1exp.cli.verbs import LISTS, POSITIONAL, SUBVERBS, VERBS, parted
from go1exp.config.choices import CONFIG_DIR, choice_files, config_folder, given_folders, groups_in, groups_of, load

OPTIONS = ("--help", "--cfg", "--multirun", "--config-dir", "--resolve", "--package", "--info")
STAGES = ("check", "localise", "replay", "explain", "apply", "report", "view")
"""Words after ``gap``."""

RUNS = ("run", "resume", "start_from", "folders")
"""Last words of keys that take a run folder, or folders with runs in them."""

RUN_FILE = "config.yaml"
MANY = 3000
"""Entries of a folder that are looked at, at a key press, to see whether it leads to a run."""

POLICIES = ("policy", "start_from")
YAML = (".yaml", ".yml")
SUFFIXES = {
    "logs": (".parquet",),
    "log": (".parquet",),
    "recordings": (".parquet",),
    "files": (".parquet",),
    "bundle": (".zip",),
    "file": (".npz",),
    "network": (".onnx", ".pt", ".jit"),
    "subjects": (".zip",),
    "checkpoint": (".pt",),
    "command": (".csv",),
    "plugins": (".py",),
    "mjcf": (".xml", ".urdf"),
    "export_check.file": (".zip",),
    "deploy.feet": (".json",),
    "deploy.motion": (".csv",),
    **dict.fromkeys(("options", "columns", "spec"), YAML),
    **dict.fromkeys(("path", "out", "dir", "folder"), ("",)),
}
"""Last word of a key whose value is a file, also of one verb's -> endings of such files; folders are offered, too."""

WORDS = {
    "command": ("sinusoid", "keyboard", "gamepad"),
    "robot": ("sim", "go1"),
    "trunk_velocity": ("exact", "estimated"),
    "suite": ("env", "train", "actuator", "deploy", "mpc", "report", "gpu"),
    "viewer": ("auto", "clip", "live", "web"),
    "what": ("all", "terms", "groups"),
    "stage": ("all", *STAGES),
    "support": ("auto", "suspended", "ground"),
    "share": ("all", "kind", "none"),
    "target": ("tau_est", "joint_torque"),
    "device": ("auto", "cpu", "cuda"),
    "start": get_args(Start),
    "selection": ("max_t", "gain", "bic"),
    "correction": ("holm", "none"),
    "wandb": ("offline", "online"),
    "schedule": ("adaptive", "fixed", "linear"),
}
"""Last word of a key that takes one of a few words -> these."""

BASH = r"""_go1exp()
{
    local IFS=$'\n'
    COMPREPLY=($(COMP_LINE="$COMP_LINE" COMP_POINT="$COMP_POINT" COMP_WORDBREAKS="$COMP_WORDBREAKS" \
        go1exp -sc query=bash 2>/dev/null))
    if [[ ${#COMPREPLY[@]} -ne 1 || ${COMPREPLY[0]} == *[=/.,] ]]; then
        compopt -o nospace 2>/dev/null
    fi
}
complete -F _go1exp go1exp"""

FISH = """function __go1exp
    set -lx COMP_LINE (commandline -cp)
    set -lx COMP_POINT (string length -- "$COMP_LINE")
    go1exp -sc query=fish 2>/dev/null
end
complete -c go1exp -f -a '(__go1exp)'"""

SCRIPTS = {
    "install": {"bash": BASH, "zsh": f"autoload -Uz bashcompinit && bashcompinit\n{BASH}", "fish": FISH},
    "uninstall": {
        "bash": "complete -r go1exp; unset -f _go1exp",
        "zsh": "complete -r go1exp; unset -f _go1exp",
        "fish": "complete -e -c go1exp; functions -e __go1exp",
    },
}


def serve(request: str) -> int:
    """Answer ``install=SHELL``, ``uninstall=SHELL`` or ``query=SHELL``; return the exit status."""
    action, _, shell = request.partition("=")
    if action != "query":
        script = SCRIPTS.get(action, {}).get(shell)
        if script is None:
            raise Expected(f"-sc {request}: install, uninstall or query = bash, zsh or fish", status=REFUSED)
        print(script)
        return 0
    line = os.environ.get("COMP_LINE", "")
    try:
        line = line[: int(os.environ.get("COMP_POINT") or len(line))]
        words = completions(line)
        if shell == "bash":
            words = _as_bash_inserts_them(words, line, os.environ.get("COMP_WORDBREAKS", ""))
        print("".join(f"{word}\n" for word in words), end="", flush=True)
    except Exception:  # a line half typed, an unreadable folder: offering nothing is the answer
        pass
    return 0


def completions(line: str) -> list[str]:
    """Return the words that the last word of a line, which may be empty, can become."""
    words, word = _split(line)
    if not words:
        general = ("--help", "--version") if word else ()
        return [known for known in (*VERBS, *general) if known.startswith(word)]
    verb, before = words[0], words[1:]
    if verb not in VERBS:
        return []
    offered: list[str] = []
    if not before:
        offered = [sub for sub in SUBVERBS.get(verb, ()) if sub.startswith(word)]
    elif before[0] in SUBVERBS.get(verb, ()):
        verb, before = f"{verb}_{before[0]}", before[1:]
    folders = [folder for folder in given_folders(before) if folder.is_dir()]
    if before and before[-1] in CONFIG_DIR:
        return list(_paths(word, ()))
    if before and before[-1] in ("--cfg", "-c"):
        return [mode for mode in ("job", "hydra", "all") if mode.startswith(word)]
    if word.startswith("-"):
        return [option for option in OPTIONS if option.startswith(word)]
    if {"--help", "-h"} & {*before}:
        return [group for group in groups_of(verb) if group.startswith(word)]
    key, equals, value = word.partition("=")
    if equals:
        return [f"{key}={answer}" for answer in _values(verb, key.lstrip("+"), value, before, folders)]
    return [*offered, *_by_position(verb, word, before, folders), *_keys(verb, word, before, folders)]


def _split(line: str) -> tuple[list[str], str]:
    """Return the words after the program's name as a shell reads them, and the last one, as far as it is typed."""
    for closing in ("", "'", '"', "\\"):
        try:
            words = shlex.split(line + closing)
            break
        except ValueError:
            continue
    else:
        return [], ""
    begins_anew = not closing and re.search(r"(?<!\\)\s$", line) is not None
    return (words[1:], "") if begins_anew or len(words) < 2 else (words[1:-1], words[-1])


def _as_bash_inserts_them(words: Sequence[str], line: str, breaks: str) -> list[str]:
    """Return the part of each word that replaces what bash takes for the last one, quoted where no quote is open.

    That is what follows an open quote, or else the last ``=`` or ``:`` where these break words.
    """
    quote = start = 0
    for place, letter in enumerate(line):
        if not quote and letter in "'\"" and line[place - 1 : place] != "\\":
            quote, start = ord(letter), place
        elif quote and letter == chr(quote):
            quote = 0
    if quote:
        before = line[:start].rpartition(" ")[2]
        return [word.removeprefix(before) for word in words]
    typed = re.split(r"(?<!\\)\s", line)[-1].replace("\\", "")
    cut = max((typed.rfind(letter) for letter in "=:" if letter in breaks), default=-1) + 1
    return [re.sub(r"([^\w/=.,:~+\[\]{}@%-])", r"\\\1", word[cut:]) for word in words]


def _by_position(verb: str, word: str, before: Sequence[str], folders: Sequence[Path]) -> list[str]:
    keys = POSITIONAL.get(verb, ())
    place = len(parted(before)[2])
    if not keys or (place >= len(keys) and keys[0] not in LISTS):
        return []
    key = keys[min(place, len(keys) - 1)]
    if key == "stage":
        return [stage for stage in STAGES if stage.startswith(word)]
    if key == "group":
        return [name for name in _listed(folders) if name.startswith(word)]
    if key == "source":
        return sorted(name for name in _importers() if name.startswith(word))
    named = [name for name in _shipped() if name.startswith(word)] if key == "subjects" else []
    return [*named, *_places(verb, key, word)]


def _shipped() -> list[str]:
    return sorted(file.parent.name for file in (data_root() / "assets/policies").glob("*/config.yaml"))


def _listed(folders: Sequence[Path]) -> list[str]:
    return sorted({*(group for folder in folders for group in groups_in(folder)), "importer", "excitation", "measure"})


def _importers() -> list[str]:
    """Return the names of the importers, read from the source: importing it takes too long for a key."""
    files = (data_root() / "go1exp/logs/importers").glob("[a-z]*.py")
    return [name for file in files for name in re.findall(r'^@importer\("(\w+)"\)', file.read_text(), re.MULTILINE)]


# ---------------------------------------------------------------------- values


def _values(verb: str, key: str, value: str, before: Sequence[str], folders: Sequence[Path]) -> Iterator[str]:
    """Complete a value; of a list, and of a sweep's choices, the last member."""
    bracket = "[" if value.startswith("[") else ""
    done, comma, member = value.removeprefix("[").rpartition(",")
    if (bracket or comma) and not re.search(r"[\[\]{}]", done + member):
        chosen = done.split(",")
        for answer in _members(verb, key, member, before, folders):
            if answer not in chosen:
                yield f"{bracket}{done}{comma}{answer}"
    elif not bracket:
        yield from _members(verb, key, value, before, folders)


def _members(verb: str, key: str, value: str, before: Sequence[str], folders: Sequence[Path]) -> list[str]:
    last = key.rsplit(".", 1)[-1]
    answers: list[str] = []
    if key in groups_of(verb) or (key not in _settings(verb) and any(key in groups_in(folder) for folder in folders)):
        answers += _levels(choice_files(key, folders), value)
        if not answers or "/" in value:
            answers += [a for a in _paths(value, YAML) if a not in answers] if value else []
        return answers
    if last in POLICIES:
        answers += [name for name in _shipped() if name.startswith(value)]
    if last in WORDS and (key != "robot" or verb == "deploy"):
        answers += [name for name in WORDS[last] if name.startswith(value)]
    if (verb, key) == ("list", "group"):
        answers += [name for name in _listed(folders) if name.startswith(value)]
    if {last, f"{verb}.{last}"} & {*RUNS, *SUFFIXES} and not (last == "command" and not value):
        places = [*(_checkpoints(before) if last == "checkpoint" else ()), *_places(verb, last, value)]
        answers += [place for place in places if place.startswith(value)]
    if not answers:
        default = _select(_settings(verb, before, folders), key)
        known = ("true", "false") if isinstance(default, bool) else () if default is None else (_plain(default),)
        answers = [text for text in known if text.startswith(value)]
    return answers


def _levels(names: Sequence[str] | dict[str, Path], value: str) -> list[str]:
    """Complete names with slashes one level at a time: ``ablation/`` before what lies in it."""
    depth = value.count("/") + 1
    matching = [name for name in names if name.startswith(value)]
    levels = ("/".join(name.split("/")[:depth]) + ("/" if name.count("/") >= depth else "") for name in matching)
    return list(dict.fromkeys(levels))


def _places(verb: str, key: str, value: str) -> Iterator[str]:
    endings = () if key in RUNS else SUFFIXES.get(f"{verb}.{key}") or SUFFIXES[key]
    return _paths(value, endings, runs=key in (*RUNS, "subjects"))


def _paths(value: str, suffixes: Sequence[str], runs: bool = False) -> Iterator[str]:
    """Complete a path: folders with a slash, files with one of the endings; with ``runs``, run folders without one.

    Of runs alone, without endings, only run folders and folders that lead to some are offered.
    """
    head, slash, tail = value.rpartition("/")
    folder = Path(head + slash).expanduser()
    for path in sorted(folder.iterdir(), key=lambda p: p.name) if folder.is_dir() else ():
        if not path.name.startswith(tail) or (path.name.startswith(".") and not tail.startswith(".")):
            continue
        if path.is_dir():
            if not runs or suffixes or _leads_to_run(path):
                yield f"{head}{slash}{path.name}" + ("" if runs and (path / RUN_FILE).is_file() else "/")
        elif suffixes and path.name.endswith(tuple(suffixes)):
            yield f"{head}{slash}{path.name}"


def _leads_to_run(folder: Path) -> bool:
    """Return whether a folder is a run or has one below; true, too, where it has too many entries to know."""
    entries = 0
    for _, below, files in os.walk(folder):
        entries += len(below) + len(files)
        if RUN_FILE in files or entries > MANY:
            return True
        below[:] = [name for name in below if not name.startswith(".")]
    return False


def _checkpoints(before: Sequence[str]) -> list[str]:
    run = next((Path(word[len("run=") :]) for word in before if word.startswith("run=")), None)
    return sorted(file.name for file in (run / "checkpoints").glob("*.pt")) if run else []


# ---------------------------------------------------------------------- keys


def _keys(verb: str, word: str, before: Sequence[str], folders: Sequence[Path]) -> list[str]:
    """Complete a key up to its next dot, ``=`` after a whole one; after ``~`` what can be removed."""
    mark = word[:1] if word[:1] in ("+", "~") else ""
    word = word[len(mark) :]
    settings = _settings(verb, before, folders)
    path, dot, _ = word.rpartition(".")
    inside = _select(settings, path) if dot else settings
    known = inside if isinstance(inside, dict) else {}
    groups = {} if dot else groups_of(verb)
    keys = []
    for name, value in known.items():
        is_mapping = isinstance(value, dict) and bool(value)
        if mark == "~":
            keys.append(f"{path}{dot}{name}")
        elif name in groups:
            keys += [f"{name}=", f"{name}."] if is_mapping and word and not mark and "/" not in name else [f"{name}="]
        else:
            keys.append(f"{path}{dot}{name}{'.' if is_mapping else '='}")
    if not dot:
        keys += [f"{group}=" for group in groups if group not in known]
        others = (group for folder in folders[1:] for group in groups_in(folder))
        keys += [f"{group}=" for group in others if mark == "+" or group in groups]
    return list(dict.fromkeys(mark + key for key in keys if key.startswith(word)))


def _settings(verb: str, words: Sequence[str] = (), folders: Sequence[Path] = ()) -> dict[str, Any]:
    """Return the verb's keys and defaults with the choices among the words: composed near enough to know the keys."""
    content = load(config_folder() / f"{verb}.yaml")
    settings = {key: value for key, value in content.items() if key not in ("defaults", "hydra")}
    given = dict(word.lstrip("+").split("=", 1) for word in words if "=" in word)
    for group, default in groups_of(verb).items() if folders else ():
        files = choice_files(group, folders)
        for choice in given.get(group, default or "").strip("[]").split(","):
            if choice in files:
                chosen, is_global = _file(files, choice, group)
                target = settings if is_global else settings.setdefault(group, {})
                _merge(target, chosen)
    return settings


def _file(files: dict[str, Path], choice: str, group: str) -> tuple[dict[str, Any], bool]:
    """Return what a choice holds, with the files that it builds on, and whether it sets keys of every group."""
    content = load(files[choice])
    whole: dict[str, Any] = {}
    for base in content.pop("defaults", ()):
        if isinstance(base, str) and base in files:
            _merge(whole, _file(files, base, group)[0])
    _merge(whole, content)
    return whole, "# @package _global_" in files[choice].read_text(encoding="utf-8")


def _merge(into: dict[str, Any], other: dict[str, object]) -> None:
    for key, value in other.items():
        if isinstance(value, dict) and isinstance(into.get(key), dict):
            _merge(into[key], value)
        else:
            into[key] = value


def _select(settings: Any, path: str) -> Any:
    for name in path.split("."):
        settings = settings.get(name) if isinstance(settings, dict) else None
    return settings


def _plain(value: object) -> str:
    if isinstance(value, dict):
        return ""
    return f"[{','.join(map(str, value))}]" if isinstance(value, list) else str(value)
