"""Values per joint as a user types them: a number, a list or a mapping, whatever form the file has."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from go1exp.cli.app import App
from go1exp.config.compose import compose
from go1exp.config.schema.joint_values import spread
from go1exp.config.schema.registry import ConfigError
from go1exp.robot import JOINTS
from go1exp.sim.task import parse_task


def composed_by_app(tmp_path: Path, *arguments: str) -> dict[str, Any]:
    """Run the verb ``train`` in this process, with a task that only keeps its configuration."""
    kept: list[dict[str, Any]] = []
    status = App("train", kept.append).run([*arguments, f"hydra.run.dir={tmp_path / 'run'}"])
    assert status == 0
    return kept[0]


@pytest.mark.parametrize(
    ("arguments", "effect", "value"),
    [
        (["effect=coulomb", "effect.coulomb.bound={calf: 0.1}"], "coulomb", {"calf": 0.1}),
        (["effect=coulomb", "effect.coulomb.bound=0.4"], "coulomb", 0.4),
        (["effect=coulomb", "effect.coulomb.bound=[0.1,0.2,0.3]"], "coulomb", [0.1, 0.2, 0.3]),
        (["effect=coulomb", "++effect.coulomb.bound={calf: 0.1, FR: 0.2}"], "coulomb", {"calf": 0.1, "FR": 0.2}),
        (["effect=viscous", "effect.viscous.damping={FR_hip: 0.1}"], "viscous", {"FR_hip": 0.1}),
        (["+effect.viscous={damping: {calf: 0.1}}"], "viscous", {"calf": 0.1}),
    ],
)
def test_a_value_per_joint_may_have_any_form_on_the_command_line(
    tmp_path: Path, arguments: list[str], effect: str, value: object
) -> None:
    config = composed_by_app(tmp_path, *arguments)
    (name,) = {"coulomb": ("bound",), "viscous": ("damping",)}[effect]
    assert config["effect"][effect][name] == value
    (checked,) = parse_task(config).effect
    expected = spread(tuple(value) if isinstance(value, list) else value, JOINTS)  # type: ignore[arg-type]
    np.testing.assert_array_equal(spread(checked.parameters[name], JOINTS), expected)


def test_a_mapping_replaces_the_mapping_of_a_file_and_a_list_does_so_too(tmp_path: Path) -> None:
    """A joint that a mapping leaves out is without the effect (docs/configuration.md)."""
    file = tmp_path / "mine.yaml"
    file.write_text("coulomb:\n  bound: {hip: 0.2, calf: 0.3}\n")
    for given, expected in (("{calf: 0.1}", {"calf": 0.1}), ("[0.1,0.1,0.2]", [0.1, 0.1, 0.2])):
        config = composed_by_app(tmp_path, f"effect={file}", f"effect.coulomb.bound={given}")
        assert config["effect"]["coulomb"]["bound"] == expected


def test_the_gains_of_a_drive_in_a_wrapper_may_be_a_mapping(tmp_path: Path) -> None:
    config = composed_by_app(
        tmp_path, "actuator=delay", "actuator@actuator.drive=dc_motor", "actuator.drive.stall={calf: 50.0, hip: 30.0}"
    )
    assert config["actuator"]["drive"]["stall"] == {"calf": 50.0, "hip": 30.0}
    assert config["actuator"]["drive"]["term"] == "dc_motor"


def test_overrides_in_python_take_the_same_forms() -> None:
    config = compose("train", ["effect=coulomb", "effect.coulomb.bound={calf: 0.1}"])
    assert config["effect"]["coulomb"]["bound"] == {"calf": 0.1}


def test_a_misspelt_parameter_with_a_mapping_is_refused_with_the_nearest_name(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"'effect\.coulomb\.bund'; did you mean 'effect\.coulomb\.bound'"):
        composed_by_app(tmp_path, "effect=coulomb", "effect.coulomb.bund={calf: 0.1}")


def test_a_sweep_over_mappings_gives_each_job_its_value(tmp_path: Path) -> None:
    kept: list[dict[str, Any]] = []
    status = App("train", kept.append).run(
        [
            "-m",
            "effect=coulomb",
            "effect.coulomb.bound={calf: 0.1},{hip: 0.2}",
            f"hydra.sweep.dir={tmp_path}",
            "hydra.sweep.subdir=${hydra.job.num}",
        ]
    )
    assert status == 0
    assert [config["effect"]["coulomb"]["bound"] for config in kept] == [{"calf": 0.1}, {"hip": 0.2}]
