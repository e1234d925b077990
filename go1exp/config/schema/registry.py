"""Name in a YAML file -> one function or class, with its parameters checked before anything is built.

A term is registered under the name that the YAML uses; its keyword-only parameters, with their annotations and
defaults, are its schema::

    @reward("foot_slip")
    def foot_slip(s: Snapshot, *, speed_scale: Positive = 0.1) -> Tensor: ...

Problems are collected, not raised one by one, so that a user sees all of them at once.
"""

from __future__ import annotations

import difflib
import inspect
import json
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Annotated, Any, ClassVar, TypeVar, get_type_hints

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, create_model

from go1exp.base.errors import Expected as Expected  # where everything above the runtime takes it from

F = TypeVar("F", bound=Callable[..., Any])

STRICT = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)
"""Pydantic settings of every schema: no unknown key, no silent conversion between types, finite numbers only."""


class Strict:
    """Base of dataclasses that pydantic checks by the rules of ``STRICT``."""

    __pydantic_config__: ClassVar[ConfigDict] = STRICT


Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Gain = Annotated[float, Field(ge=0, le=1023)]
"""Of a motor, N m/rad or N m s/rad; at most what the Go1's packets carry."""
Count = Annotated[int, Field(ge=1, le=10**9)]
CountOrZero = Annotated[int, Field(ge=0, le=2**32 - 1)]
Duration = Annotated[float, Field(gt=0, le=1e9)]
"""A length of time of which steps are counted, s; at most 32 years."""
Fraction = Annotated[float, Field(ge=0, le=1)]


def ordered(bounds: tuple[float, float]) -> tuple[float, float]:
    """Refuse a range whose low exceeds its high."""
    if bounds[0] > bounds[1]:
        raise ValueError("low must not exceed high")
    return bounds


Range = Annotated[tuple[float, float], AfterValidator(ordered)]
"""``[low, high]`` of a uniform distribution."""
PositiveRange = Annotated[tuple[Positive, Positive], AfterValidator(ordered)]


def within(low: float, high: float, unit: str) -> AfterValidator:
    """Return a check that a number is from ``low`` to ``high``, in ``unit``; the message says both."""

    def check(value: float) -> float:
        if not low <= value <= high:
            raise ValueError(f"must be from {low:g} to {high:g} {unit}")
        return value

    return AfterValidator(check)


def one_of(pattern: str, known: str) -> AfterValidator:
    """Return a check that a text matches a pattern; the message has what is ``known``, such as cpu or cuda."""

    def check(value: str) -> str:
        if not re.fullmatch(pattern, value):
            raise ValueError(f"must be {known}")
        return value

    return AfterValidator(check)


Speed = Annotated[float, within(-100.0, 100.0, "(m/s or rad/s)")]
"""A velocity, m/s, or yaw rate, rad/s: no robot reaches the ends, and squares stay finite far beyond them."""
SpeedRange = Annotated[tuple[Speed, Speed], AfterValidator(ordered)]


class ConfigError(ValueError):
    """Things wrong with a configuration; the message has one line for each, starting with its key path."""

    def __init__(self, problems: Iterable[str] | Exception) -> None:
        self.problems = str(problems).split("\n") if isinstance(problems, str | Exception) else list(problems)
        super().__init__("\n".join(self.problems))


class TooLongError(ConfigError):
    """A length of time that does not fit into memory: its setting is wrong whatever it is for."""


class DuplicateError(ValueError):
    """A name that a group has already; the message names both places."""


FolderName = Annotated[str, Field(min_length=1)]
"""The name of a folder: an empty one, as an unset variable of the shell leaves it, is a mistake."""


def nearest(name: str, known: Iterable[str], most: int = 3) -> list[str]:
    """Return up to ``most`` names of ``known`` that look like ``name``, best first."""
    return difflib.get_close_matches(name, list(known), n=most, cutoff=0.6 if len(name) > 3 else 0.5)


def unknown_name(path: str, name: str, known: Iterable[str], what: str) -> str:
    """Word the complaint about a name that does not exist."""
    known = sorted(known)
    close = nearest(name, known)
    hint = f"did you mean {' or '.join(repr(c) for c in close)}?" if close else f"known: {', '.join(known) or 'none'}"
    return f"{path}: unknown {what} {name!r}; {hint}"


def as_json(settings: object) -> str:
    """Dump settings for a strict schema, which takes lists for tuples and mappings for dataclasses only from JSON."""
    return json.dumps(settings)


_UNION_MEMBER = re.compile(r"(str|int|float|bool|none)$|.+\[.+\]$")
"""What pydantic puts between the keys where a value may be of several types: the type that it tried."""


Place = tuple[int | str, ...]
"""Where pydantic found an error: keys, numbers of items, and types that it tried."""


def explain(error: ValidationError, path: str, known: Iterable[str]) -> list[str]:
    """Translate a pydantic error into lines ``key.path = value: what is wrong``."""
    lines: list[str] = []
    errors = error.errors()
    foreign = _foreign([e["loc"] for e in errors], [e["type"] for e in errors])
    for e in errors:
        if e["loc"] in foreign:
            continue
        if e["type"] == "too_short" and len(e["input"]) >= e["ctx"]["min_length"]:
            continue  # long enough as it was given: its items are wrong, and each is an error of its own
        places = [str(place) for place in e["loc"]]
        unknown = e["type"] in ("extra_forbidden", "unexpected_keyword_argument")
        last = len(places) - 1
        keys = [p for i, p in enumerate(places) if (unknown and i == last) or not _is_member(p)]
        key = ".".join([path, *keys]).strip(".")
        if unknown:
            lines.append(unknown_name(key, str(e["loc"][-1]), known, "key") + f" (given: {e['input']!r})")
        elif e["type"] == "value_error" and (not e["loc"] or isinstance(e["input"], Mapping)):
            # rules of a dataclass, one "key: rule" per line
            lines += [f"{key}.{line}".strip(".") for line in e["msg"].removeprefix("Value error, ").splitlines()]
        elif e["type"] == "problems":  # a term inside this one: one line each, from that parameter's name on
            lines += [".".join([path, *map(str, e["loc"][:-1]), line]).strip(".") for line in e["msg"].splitlines()]
        elif e["type"] in ("missing", "missing_argument"):
            lines.append(f"{key}: required, but not given")
        else:
            message = e["msg"].removeprefix("Value error, ")
            # A value that is quoted in it stays as it was written.
            value, what = f"{key} = {repr(e['input'])[:400]}: ", message[:1].lower() + message[1:]
            if len(keys) < len(places) and lines and lines[-1].startswith(value):  # the next type that it may be of
                lines[-1] += f" or {what.removeprefix('input should be ')}"
            else:
                lines.append(value + what)
    return lines


def _foreign(places: Sequence[Place], kinds: Sequence[str]) -> set[Place]:
    """Return where a value is only of another type, and one more of its possible types says what is wrong inside it."""
    other = {p for p, kind in zip(places, kinds, strict=True) if p and kind.endswith("_type") and _is_member(p[-1])}
    inside = {p[:k] for p in places if p not in other for k in range(len(p)) if _is_member(p[k])}
    return {p for p in other if p[:-1] in inside}


def _is_member(place: int | str) -> bool:
    return _UNION_MEMBER.match(str(place)) is not None


@dataclass(frozen=True)
class Entry:
    """One registered member: its group, name and target, and what the group needs to know about it (``traits``)."""

    group: str
    name: str
    target: Callable[..., Any]
    traits: Mapping[str, Any] = field(default_factory=dict)

    @property
    def doc(self) -> str:
        """First line of the docstring."""
        return (inspect.getdoc(self.target) or "").split("\n")[0]

    @cached_property
    def parameters(self) -> dict[str, inspect.Parameter]:
        """The keyword-only parameters, which the YAML may set."""
        every = inspect.signature(self.target).parameters.values()
        return {p.name: p for p in every if p.kind is inspect.Parameter.KEYWORD_ONLY}

    @property
    def remembers(self) -> bool:
        """Whether the member is a class, whose objects carry state from one step to the next."""
        return inspect.isclass(self.target)

    @property
    def place(self) -> str:
        """File and line of the definition."""
        file = getattr(sys.modules.get(self.target.__module__), "__file__", None) or self.target.__module__
        try:
            return f"{file}:{inspect.getsourcelines(self.target)[1]}"
        except (OSError, TypeError):  # typed in at a prompt
            return file

    @cached_property
    def schema(self) -> type[BaseModel]:
        """Pydantic model of the parameters."""
        # Parameters that a class has of another one are annotated in the words of that one's module.
        homes = reversed(inspect.getmro(self.target)) if inspect.isclass(self.target) else (self.target,)
        scope = {name: value for home in homes for name, value in vars(sys.modules[home.__module__]).items()}
        fields: dict[str, Any] = {}
        for name, p in self.parameters.items():
            # Only these annotations are evaluated: the positional ones name tensors, which need no import here.
            stub = type(name, (), {"__annotations__": {name: p.annotation}})
            kind = get_type_hints(stub, globalns=dict(scope), include_extras=True)[name]
            fields[name] = (kind, ... if p.default is p.empty else p.default)
        return create_model(self.name, __config__=STRICT, **fields)

    def untyped(self) -> str | None:
        """Return what is wrong with the types of the parameters, of which the schema is made; None if nothing is."""
        if bare := [name for name, p in self.parameters.items() if p.annotation is p.empty]:
            return f"parameter {bare[0]!r} needs a type, such as {bare[0]}: float"
        try:
            self.schema  # noqa: B018  (made once)
        except Exception as error:  # a name that is not known, a type that no YAML can give
            return f"a parameter has no usable type ({str(error).strip().splitlines()[0]})"
        return None

    def check(self, parameters: Mapping[str, object], path: str) -> tuple[dict[str, Any], list[str]]:
        """Validate ``parameters``; return them with defaults filled in, and the problems."""
        try:
            values = self.schema.model_validate_json(as_json(parameters)).model_dump()
        except ValidationError as error:
            return {}, explain(error, path, self.parameters)
        return values, []


_REGISTRY: dict[str, dict[str, Entry]] = {}

MORE: list[Callable[[], object]] = []
"""Called when a name is not known, to register what else is installed (``config/schema/plugins.py``)."""


def register(group: str, name: str, **traits: object) -> Callable[[F], F]:
    """Class or function decorator: make the target known to ``group`` as ``name``.

    Raises:
        DuplicateError: if the group has a member of that name.
    """

    def decorate(target: F) -> F:
        add(Entry(group, name, target, traits))
        return target

    return decorate


def add(entry: Entry) -> None:
    """Make a member known; raise DuplicateError if its group has one of that name."""
    members = _REGISTRY.setdefault(entry.group, {})
    other = members.get(entry.name)
    if other is not None:
        raise DuplicateError(
            f"{entry.group} term {entry.name!r} of {entry.place} exists already, in {other.place}; choose another name"
        )
    members[entry.name] = entry


def remove(entry: Entry) -> None:
    """Make a member unknown again."""
    if _REGISTRY.get(entry.group, {}).get(entry.name) is entry:
        del _REGISTRY[entry.group][entry.name]


@contextmanager
def collected() -> Iterator[list[Entry]]:
    """Yield a list that holds, at the end, the foreign members registered in between; an error makes them unknown."""
    before = {id(entry) for entry in foreign()}
    new: list[Entry] = []
    try:
        yield new
    except BaseException:
        for entry in [e for e in foreign() if id(e) not in before]:
            remove(entry)
        raise
    new += [e for e in foreign() if id(e) not in before]


def foreign() -> list[Entry]:
    """Return the members that this package did not register."""
    every = [entry for members in _REGISTRY.values() for entry in members.values()]
    return [entry for entry in every if entry.target.__module__.split(".")[0] != "go1exp"]


reward = partial(register, "reward")
observation = partial(register, "observation")
randomization = partial(register, "rand")
command = partial(register, "command")
event = partial(register, "event")
termination = partial(register, "termination")
curriculum = partial(register, "curriculum")
actuator = partial(register, "actuator")
importer = partial(register, "importer")
effect = partial(register, "effect")
excitation = partial(register, "excitation")
measure = partial(register, "measure")
protocol = partial(register, "protocol")


def members(group: str) -> dict[str, Entry]:
    """All members of ``group`` by name, in the order in which they were registered."""
    return dict(_REGISTRY.get(group, {}))


def find(group: str, name: Any) -> Entry | None:
    """Return a member, or None; a name that is not known has the installed packages searched for it (``MORE``)."""
    if name not in _REGISTRY.get(group, {}):
        for search in MORE:
            search()
    return _REGISTRY.get(group, {}).get(name)


def groups() -> list[str]:
    """The names of all groups that have members."""
    return [group for group, members in _REGISTRY.items() if members]


@dataclass(frozen=True)
class Term:
    """A registered member as one configuration uses it.

    ``key`` is the YAML key (``slip_tight``), ``entry`` the member it names, ``parameters`` its checked parameters,
    ``slots`` what the group itself reads (a reward's ``weight``, an observation's ``noise``).
    """

    key: str
    entry: Entry
    parameters: Mapping[str, Any]
    slots: Mapping[str, Any] = field(default_factory=dict)

    def __call__(self, *args: object) -> Any:
        """Call the member (for a class: construct it) with ``args`` and the configured parameters."""
        return self.entry.target(*args, **self.parameters)


def bind_list(group: str, given: Iterable[object], path: str) -> list[Term]:
    """Resolve a list of names and of ``{name: {parameter: value}}``; raise ConfigError with every problem of them."""
    items = [pair for item in given for pair in (item.items() if isinstance(item, Mapping) else [(item, {})])]
    bound = [bind(group, str(key), value, f"{path}.{key}") for key, value in items]
    if problems := [problem for _, term_problems in bound for problem in term_problems]:
        raise ConfigError(problems)
    return [term for term, _ in bound if term]


def bind(
    group: str, key: str, settings: object, path: str, slots: type[BaseModel] | None = None
) -> tuple[Term | None, list[str]]:
    """Resolve one YAML item ``key: settings`` of ``group``; return the term (None if bad) and the problems.

    ``settings`` holds the term's parameters beside the group's own ``slots``; an item named differently from its
    term says ``term: name``.
    """
    if settings is None:
        settings = {}
    if not isinstance(settings, Mapping):
        return None, [f"{path} = {settings!r}: must be a mapping of parameters, such as {{}}"]
    settings = dict(settings)
    name = settings.pop("term", key)
    entry = find(group, name)
    if entry is None:
        return None, [unknown_name(path, str(name), members(group), f"{group} term")]
    slot_names = set(slots.model_fields) if slots else set()
    of_group = {k: v for k, v in settings.items() if k in slot_names}
    rest = {k: v for k, v in settings.items() if k not in slot_names}
    values, problems = entry.check(rest, path)
    if problems and slot_names:  # so that a misspelt slot finds its name too
        known = [*entry.parameters, *slot_names]
        strange = [k for k in rest if k not in entry.parameters]
        others = [p for p in problems if not any(p.startswith(f"{path}.{k}: unknown key") for k in strange)]
        named = [unknown_name(f"{path}.{k}", k, known, "key") + f" (given: {rest[k]!r})" for k in strange]
        problems = others + named
    checked: dict[str, Any] = {}
    if slots:
        try:
            checked = slots.model_validate_json(as_json(of_group)).model_dump()
        except ValidationError as error:
            problems += explain(error, path, slot_names)
    return (None, problems) if problems else (Term(key, entry, values, checked), [])
