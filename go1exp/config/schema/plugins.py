"""Terms of users: files and packages that register terms of any kind when they are loaded.

A configuration names them (``plugins=[my_terms.py, my_package]``), the environment variable ``GO1EXP_PLUGINS`` does for
every command, and an installed package can offer itself (entry point group ``go1exp.extend``): it is imported when a
term is requested that is not registered. ``docs/extending.md`` is the users' page.

The registry always holds the terms of the configuration at hand and not those of the one before: ``use`` says which.
A file is executed once for each content that it has, however often it is named.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.machinery
import importlib.metadata
import importlib.util
import os
import sys
import traceback
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from go1exp.config.schema import registry
from go1exp.config.schema.registry import ConfigError, DuplicateError, Entry

VARIABLE = "GO1EXP_PLUGINS"
"""Environment variable: files and packages, separated as in PATH."""

GROUP = "go1exp.extend"
"""Entry points of this group are modules that register terms."""

KEY = "plugins"


@dataclass(frozen=True)
class Plugin:
    """A loaded file or package.

    Attributes:
        name: as it was requested.
        module: under which Python knows it.
        file: of a file, its path.
        content: of a file, what was executed.
        entries: what it has registered.
    """

    name: str
    module: str
    file: Path | None
    content: bytes | None
    entries: tuple[Entry, ...]

    @property
    def sha256(self) -> str | None:
        """Of a file, the hash of its content."""
        return None if self.content is None else hashlib.sha256(self.content).hexdigest()


_loaded: dict[str, Plugin] = {}
"""By module, whether in force or not."""
_active: dict[str, Plugin] = {}
"""Those in force, by module."""
_by_hand: list[str] = []
"""In force whatever the configuration."""
_installed: dict[str, Plugin] | None = None
"""Of entry points, once they have been searched."""


def names(given: object) -> list[str]:
    """Return the plugins that a configuration's value means, one or a list; raise ConfigError if it is neither."""
    if given is None:
        return []
    listed = [given] if isinstance(given, str) else given
    if not isinstance(listed, Sequence) or not all(isinstance(name, str) and name for name in listed):
        raise ConfigError(
            [f"{KEY} = {given!r}: must be a list of files and packages, such as [my_terms.py,my_package]"]
        )
    return list(listed)


def load(*wanted: str) -> list[Plugin]:
    """Load plugins for the rest of the process, whatever the configuration.

    Args:
        wanted: paths of files (ending in ``.py``) and names of packages.

    Raises:
        ConfigError: one line for each that is missing, fails, or registers nothing.
    """
    plugins = use(wanted)
    _by_hand.extend(name for name in wanted if name not in _by_hand)
    return [p for p in plugins if p.name in wanted]


def begin(wanted: Sequence[str] | None = None) -> None:
    """Begin a command with these plugins, and forget those loaded by hand; errors as ``load``'s.

    Args:
        wanted: None loads nothing yet: the command does, with its configuration.
    """
    _by_hand.clear()
    if wanted is not None:
        load(*wanted)


def use(wanted: object = ()) -> list[Plugin]:
    """Put into force a configuration's plugins, those of the environment variable and those loaded by hand.

    Of two files with one name and different contents, the configuration's counts: a run's copy goes before the file
    that has changed since.

    Args:
        wanted: as the key ``plugins`` has it.

    Returns:
        all plugins that are now in force, but for those of entry points.

    Raises:
        ConfigError: one line for each that is missing, fails, or registers nothing or a name that exists already.
    """
    first = names(wanted)
    of_first = {Path(name).name for name in first}
    others = [n for n in [*os.environ.get(VARIABLE, "").split(os.pathsep), *_by_hand] if n]
    chosen: dict[str, tuple[str, Path | None]] = {}
    problems: list[str] = []
    for name in [*first, *(n for n in others if Path(n).name not in of_first)]:
        try:
            module, file = _module(name)
            chosen.setdefault(module, (name, file))
        except ConfigError as error:
            problems += error.problems
    _keep_active(chosen)
    for module, (name, file) in chosen.items():
        try:
            _activate(module, name, file)
        except ConfigError as error:
            problems += error.problems
    if problems:
        raise ConfigError(dict.fromkeys(problems))
    return list(_active.values())


@contextmanager
def restored() -> Iterator[None]:
    """Have the plugins in force after the block that were before it."""
    before = dict(_active)
    try:
        yield
    finally:
        _keep_active(before)
        for module, plugin in before.items():
            _activate(module, plugin.name, plugin.file)


def installed() -> list[Plugin]:
    """Import the packages that offer terms by an entry point, once; return them.

    Raises:
        ConfigError: one line for each that fails.
    """
    global _installed
    if _installed is not None:
        return list(_installed.values())
    _installed = {}
    problems = []
    for point in importlib.metadata.entry_points(group=GROUP):
        if point.module in _active:
            continue
        try:
            _installed[point.module] = _import(point.module, point.module, None)
        except ConfigError as error:
            problems += [f"entry point {point.name!r} of {GROUP}: {line}" for line in error.problems]
    if problems:
        raise ConfigError(problems)
    return list(_installed.values())


def origin(entry: Entry) -> str | None:
    """Return the plugin that a member is from, as it was requested; None for one of this package."""
    return next((p.name for p in in_force() if any(e is entry for e in p.entries)), None)


def in_force() -> list[Plugin]:
    """Return all plugins in force, entry points included."""
    return [*_active.values(), *(_installed or {}).values()]


def blamed(error: BaseException) -> str | None:
    """Return the term and line of a plugin that an error comes from, such as ``reward.slip (mine.py:12)``, or None."""
    for frame, line in reversed(list(traceback.walk_tb(error.__traceback__))):
        module, code = str(frame.f_globals.get("__name__")), frame.f_code
        plugin = next((p for p in in_force() if f"{module}.".startswith(f"{p.module}.")), None)
        if plugin is not None:
            term = code.co_qualname.partition(".")[0]
            named = next((f"{e.group}.{e.name}" for e in plugin.entries if e.target.__qualname__ == term), code.co_name)
            return f"{named} ({plugin.name if plugin.file else code.co_filename}:{line})"
    return None


# ---------------------------------------------------------------------- one plugin


def is_file(name: str) -> bool:
    """Return whether a plugin's name means a file, and not a package."""
    return name.endswith(".py") or os.sep in name


def sha256(file: Path) -> str:
    """Return the hash of a file's content."""
    return hashlib.sha256(file.read_bytes()).hexdigest()


def _module(name: str) -> tuple[str, Path | None]:
    """Return the module's name of a plugin, which of a file is that of its content, and the file."""
    if not is_file(name):
        return name, None
    path = Path(name).expanduser()
    if not path.is_file():
        what = "is a folder; give the files in it, or install it as a package" if path.is_dir() else "no such file"
        raise ConfigError([f"{KEY}: {name}: {what}"])
    try:
        return f"go1exp_plugin_{path.stem}_{sha256(path)[:12]}", path.resolve()
    except OSError as error:
        raise ConfigError([f"{KEY}: {name}: {error.strerror}"]) from None


def _keep_active(modules: Collection[str]) -> None:
    for module in [m for m in _active if m not in modules]:
        for entry in _active.pop(module).entries:
            registry.remove(entry)


def _activate(module: str, name: str, file: Path | None) -> None:
    if module in (_installed or {}):
        return
    if module in _active:
        _active[module] = replace(_active[module], name=name, file=file)
        return
    plugin = _loaded.get(module)
    if plugin is None:
        _active[module] = _import(module, name, file)
        return
    try:
        for entry in plugin.entries:
            registry.add(entry)
    except DuplicateError as error:
        for entry in plugin.entries:  # those that came before it
            registry.remove(entry)
        raise ConfigError([f"{KEY}: {error}"]) from None
    _active[module] = replace(plugin, name=name, file=file)  # the same content may lie in another place by now


class _FromContent(importlib.machinery.SourceFileLoader):
    """Executes the content that was read once; no ``__pycache__`` comes to lie beside a user's file."""

    def __init__(self, module: str, file: Path, content: bytes) -> None:
        super().__init__(module, str(file))
        self._content = content

    def get_data(self, path: str) -> bytes:
        """Return the content."""
        return self._content

    def path_stats(self, path: str) -> dict[str, object]:
        """Raise OSError: there is no byte code to compare with."""
        raise OSError


def _import(module: str, name: str, file: Path | None) -> Plugin:
    """Execute a plugin; raise ConfigError in one line if it fails or registers nothing."""
    before = set(sys.modules)
    content = file.read_bytes() if file else None
    try:
        with registry.collected() as new:
            if file is None or content is None:
                importlib.import_module(module)
            else:
                spec = importlib.util.spec_from_file_location(module, file, loader=_FromContent(module, file, content))
                assert spec is not None
                assert spec.loader is not None
                sys.modules[module] = importlib.util.module_from_spec(spec)
                spec.loader.exec_module(sys.modules[module])
    except (Exception, SystemExit) as error:  # whatever a user's file may raise
        root = module.split(".")[0]
        for other in [m for m in sys.modules if m.split(".")[0] == root and m not in before]:
            del sys.modules[other]
        raise ConfigError([f"{KEY}: {_reason(error, module, name, file)}"]) from error
    by_module = [e for e in registry.foreign() if f"{e.target.__module__}.".startswith(f"{module}.")]  # imported before
    entries = tuple({id(e): e for e in [*by_module, *new]}.values())  # entries hold mappings: not hashable
    if not entries:
        raise ConfigError(
            [f"{KEY}: {name}: registers no term; decorate one, such as @reward('my_term') (go1exp.extend)"]
        )
    if problems := [f"{KEY}: {name}: {e.group}.{e.name}: {why}" for e in entries if (why := e.untyped())]:
        for entry in entries:
            registry.remove(entry)
        raise ConfigError(problems)
    _loaded[module] = Plugin(name, module, file, content, entries)
    return _loaded[module]


def _reason(error: BaseException, module: str, name: str, file: Path | None) -> str:
    if isinstance(error, DuplicateError):
        return str(error)
    if isinstance(error, ModuleNotFoundError) and file is None and module.startswith(str(error.name)):
        if Path(f"{name}.py").is_file():
            return f"{name}: no such package; did you mean {name}.py?"
        return f"{name}: no such package is installed"
    text = (str(error).strip() or "without a message").splitlines()[0]
    if isinstance(error, SyntaxError) and error.filename:
        return f"{error.filename}:{error.lineno}: {type(error).__name__}: {error.msg}"
    frames = traceback.extract_tb(error.__traceback__)
    folder = str(file) if file else f"{os.sep}{module.replace('.', os.sep)}"
    inside = [f"{f.filename}:{f.lineno}" for f in frames if folder in f.filename] or [str(file or name)]
    return f"{inside[-1]}: {type(error).__name__}: {text}"


registry.MORE.append(installed)  # when a term is requested that is not registered
