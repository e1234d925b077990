"""Composition keeps what it has read, and still composes as Hydra does, from the files as they are."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import hydra
import pytest
from hydra import compose as hydra_compose
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra.errors import HydraException
from omegaconf import OmegaConf
from yaml import YAMLError

from go1exp.cli.app import App
from go1exp.cli.hydra_main import choices_from_files
from go1exp.config.choices import config_folder
from go1exp.config.compose import as_hydra_takes_them, compose
from go1exp.config.hydra_adapter import VerbSource, hydra_for, plain
from go1exp.config.schema.registry import ConfigError

WAYS = [
    [],
    ["seed=3", "ppo.hidden=[8,8]"],
    ["reward=paper_literal", "reward.gait.weight=2.5"],
    ["ppo.gamma=0.9", "rand=none", "ppo.gamma=0.95"],
    ["experiment=[paper,ablation/no_gait]", "ppo.iterations=7"],
    ["experiment=paper", "+experiment/ablation=no_gait"],
    ["~reward.gait"],
    ["+reward.lazy={weight: -1.0}"],
    ["++ppo.gamma=0.5", "+ppo.mine=1"],
    ["effect=[coulomb,viscous]", "effect.coulomb.bound={calf: 0.1}"],
    ["ppo.hidden=[]", "hydra.job.num=1"],
    ["robot.velocity_limit=[1.0,2.0,3.0]"],
]


def whole(verb: str, overrides: list[str]) -> dict[str, Any]:
    """What Hydra composes at once."""
    with hydra_for(verb):
        return plain(hydra_compose(verb, as_hydra_takes_them(overrides)))


@pytest.mark.parametrize("overrides", WAYS, ids=" ".join)
def test_values_set_on_kept_choices_are_what_hydra_composes(overrides: list[str]) -> None:
    expected = whole("train", overrides)
    for _ in range(2):
        given = compose("train", overrides)
        assert given == expected
        assert list(given) == list(expected)
        given["reward"].clear()  # the next one is another


def test_an_interpolation_follows_a_value_that_is_set() -> None:
    overrides = ["robot.velocity_limit=[1.0,2.0,3.0]"]
    assert compose("train", overrides)["reward"]["joint_velocity_limit"]["limit"] == [1.0, 2.0, 3.0]
    written = compose("train", overrides, resolve=False)
    assert written["reward"]["joint_velocity_limit"]["limit"] == "${robot.velocity_limit}"


@pytest.mark.parametrize(
    "override",
    ["ppo.gama=0.9", "reward=nothing", "+ppo.gamma=1", "ppo.gamma=1,2", "~ppo.nothing", "ppo.gamma=[", "seed"],
)
def test_a_refusal_is_that_of_a_whole_composition(override: str) -> None:
    messages = []
    for composing in (whole, compose):
        with pytest.raises(HydraException) as refused:
            composing("train", ["seed=2", override])
        messages.append(str(refused.value))
    assert messages[0] == messages[1]


def test_a_file_that_changes_is_read_again(tmp_path: Path) -> None:
    (tmp_path / "rand").mkdir()
    file = tmp_path / "rand" / "calm.yaml"
    for number, text in enumerate(("link_mass: {scale: [0.9, 1.1]}", "{}", "link_mass: {scale: [0.8, 1.1]}")):
        file.write_text(text)
        os.utime(file, ns=(number, number))  # however coarse the clock of the file system is
        assert compose("train", ["rand=calm"], [tmp_path])["rand"] == OmegaConf.create(text)
    (tmp_path / "rand" / "storm.yaml").write_text("{}")  # a file that is new, beside one that was read
    assert compose("train", ["rand=storm"], [tmp_path])["rand"] == {}


def test_a_choice_made_of_a_users_file_follows_the_file(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    for bound in (0.1, 0.2):
        file.write_text(f"coulomb: {{bound: {bound}}}")
        chosen = choices_from_files([f"effect={file}"], "train")
        assert compose("train", chosen)["effect"] == {"coulomb": {"bound": bound}}


def test_the_fast_parser_reads_every_file_as_omegaconf_does() -> None:
    source = VerbSource("main", str(config_folder()))
    for file in sorted(config_folder().rglob("*.yaml")):
        name = file.relative_to(config_folder()).as_posix()
        assert source.load_config(name.replace("randomization/", "rand/")).config == OmegaConf.load(file)


@pytest.mark.parametrize(
    ("words", "runs", "compositions"),
    [
        (["--multirun", "seconds=1,2"], 2, None),
        (["hydra.mode=MULTIRUN", "seconds=1,2"], 2, None),
        (["hydra.run.dir=there"], 1, 1),
        (["hydra.mode=RUN"], 1, 2),
    ],
)
def test_a_verb_composes_once_and_runs_in_the_mode_that_is_asked_for(
    words: list[str], runs: int, compositions: int | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    composed: list[Any] = []
    given: list[dict[str, Any]] = []
    load = ConfigLoaderImpl.load_configuration

    def counted(*arguments: Any, **keywords: Any) -> Any:
        composed.append(arguments)
        return load(*arguments, **keywords)

    monkeypatch.setattr(ConfigLoaderImpl, "load_configuration", counted)
    assert App("eval", given.append).run([*words, "run=there"]) == 0
    assert len(given) == runs
    assert compositions in (None, len(composed)) or hydra.__version__ >= "1.4"  # which reads the mode by itself


@pytest.mark.parametrize(
    "text", ["a: 1e3\nb: 1_0.5\nc: 2001-01-01\nd: .inf\ne: on\nf: 0x1f\n", "", "# nothing\n", "[1, a]"]
)
def test_numbers_and_dates_are_omegaconfs(text: str, tmp_path: Path) -> None:
    (tmp_path / "x.yaml").write_text(text)
    read = VerbSource("main", str(tmp_path)).load_config("x").config
    assert (read, type(read)) == (OmegaConf.load(tmp_path / "x.yaml"), type(OmegaConf.load(tmp_path / "x.yaml")))


@pytest.mark.parametrize("text", ["5\n", "a: 1\na: 2\n", "a: [1\n", "a: {b\n  c: 1", "\tx: 1"])
def test_a_broken_file_is_refused_by_its_name(text: str, tmp_path: Path) -> None:
    (tmp_path / "x.yaml").write_text(text)
    with pytest.raises((YAMLError, OSError)):
        OmegaConf.load(tmp_path / "x.yaml")
    with pytest.raises(ConfigError, match=r"x\.yaml: (no YAML \(line \d: |must be a mapping)"):
        VerbSource("main", str(tmp_path)).load_config("x")
