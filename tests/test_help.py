"""``--help``: every setting in one line from the docstrings, a verb's own groups, examples; and the words agree."""

from __future__ import annotations

import dataclasses
import io
import os
import re
import sys
from contextlib import redirect_stderr, redirect_stdout
from functools import cache
from pathlib import Path
from unittest import mock

import pytest

from go1exp.cli import EVERY, main
from go1exp.cli.app import app_of
from go1exp.cli.helptext import leaves, texts_of
from go1exp.config.choices import config_folder, groups_in, groups_of
from go1exp.config.compose import compose
from go1exp.config.schema.settings import attributes
from tests.command import refuse

TITLES = [verb.replace("_", " ") for verb in EVERY]


def conf(verb: str) -> str:
    return verb.replace(" ", "_")


@cache
def helped(*words: str) -> str:
    """What a command line prints, in this process."""
    printed, complained = io.StringIO(), io.StringIO()
    with (
        mock.patch.dict(os.environ, COLUMNS="120"),
        mock.patch.object(sys, "argv", ["go1exp", *words]),
        redirect_stdout(printed),
        redirect_stderr(complained),
    ):
        assert main() == 0
    assert complained.getvalue() == ""
    return printed.getvalue()


@pytest.mark.parametrize("verb", TITLES)
def test_the_help_of_every_verb_says_what_it_does_its_settings_and_examples(verb: str) -> None:
    text = helped(*verb.split(), "--help")
    assert text.startswith(f"go1exp {verb}: ")
    settings, examples = text.split("Examples:")
    assert len(re.findall(rf"^  go1exp {verb}\b", examples, re.MULTILINE)) >= 2
    for key in leaves({k: v for k, v in compose(conf(verb)).items() if k not in groups_of(conf(verb))}):
        assert re.search(rf"^  {re.escape(key)}=\S*( +\S|\n {{20,}}\S)", settings, re.MULTILINE), f"{key} has no line"
    assert max(map(len, settings.splitlines())) <= 120


@pytest.mark.parametrize("verb", TITLES)
def test_the_help_of_a_verb_lists_the_groups_that_it_has_and_no_other(verb: str) -> None:
    text = helped(*verb.split(), "--help").split("Settings (")[0]
    listed = [group for group in groups_in(config_folder()) if re.search(rf"^  {group}  +\S", text, re.MULTILINE)]
    assert sorted(listed) == sorted(groups_of(conf(verb)))


@pytest.mark.parametrize("verb", [verb for verb in EVERY if verb != "train"])
def test_every_documented_attribute_is_a_setting_and_every_setting_is_documented(verb: str) -> None:
    kind = app_of(verb).settings
    assert kind
    assert set(attributes(kind)) == {f.name for f in dataclasses.fields(kind)}
    assert [key for key, text in texts_of(verb).items() if not text] == []


@pytest.mark.parametrize("group", ["ppo", "robot", "terrain", "backend", "logger"])
def test_the_help_of_a_group_says_each_key_in_a_line(group: str) -> None:
    text = helped("train", "--help", group)
    for key in leaves({group: compose("train")[group]}):
        assert re.search(rf"^  {re.escape(key)}=\S*( +\S|\n {{20,}}\S)", text, re.MULTILINE), f"{key} has no line"


def test_the_help_of_a_group_of_terms_says_each_term_and_its_parameters() -> None:
    text = helped("train", "reward=paper_literal", "--help", "reward")
    for term, parameters in compose("train", ["reward=paper_literal"])["reward"].items():
        assert re.search(rf"^  reward\.{term} ", text, re.MULTILINE)
        assert all(f"    reward.{term}.{name}=" in text for name in parameters)
    assert "reward.TERM.weight" in text


def test_help_shows_what_was_chosen_and_stands_wrong_choices() -> None:
    assert "terrain.kind=tiles" in helped("train", "terrain=rough", "--help", "terrain")
    assert "grid.cross=true" in helped("eval", "grid.cross=true", "-h")
    assert "episodes=16" in helped("eval", "episode=3", "--help")


def test_help_before_the_verb_is_the_help_of_the_verb(capsys: pytest.CaptureFixture[str]) -> None:
    for word in ("--help", "help"):
        assert helped(word, "gap", "next") == helped("gap", "next", "--help")
    with mock.patch.object(sys, "argv", ["go1exp", "--help", "trian"]):
        assert main() == 2
    assert "unknown verb 'trian'; did you mean 'train'?" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("train --help rewardd", "go1exp train: no group or key 'rewardd'; did you mean 'reward'"),
        ("train epsodes --help", "go1exp train: no group or key 'epsodes'; "),
        ("train --help ppo.learning_rat", "did you mean 'ppo.learning_rate' or "),
        ("train --help xyzzy", "go1exp train: no group or key 'xyzzy'; go1exp train --help lists them"),
        ("deploy walk.zip --help comand", "go1exp deploy: no group or key 'comand'; did you mean 'command'"),
    ],
)
def test_a_word_that_there_is_no_help_for_is_refused_with_what_looks_like_it(
    line: str, message: str, tmp_path: Path
) -> None:
    done = refuse(tmp_path, *line.split())
    assert (done.returncode, done.stdout) == (2, "")
    assert message in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("line", "first"),
    [
        ("train --help ppo.learning_rate", "go1exp train: group ppo"),
        ("eval --help episodes", "go1exp eval: "),
        ("eval --help grid", "go1exp eval: "),
        ("deploy walk.zip --help", "go1exp deploy: "),
        ("report runs/a runs/b --help", "go1exp report: "),
        ("record --help audit", "go1exp record audit: "),
    ],
)
def test_help_for_a_key_a_subverb_or_beside_a_file_is_that_of_where_it_stands(line: str, first: str) -> None:
    assert helped(*line.split()).startswith(first)


def test_the_words_of_deploy_are_those_of_its_configuration() -> None:
    chosen = compose("deploy", ["robot=go1", "command=sinusoid"])
    assert (chosen["robot"], chosen["command"]) == ("go1", "sinusoid")
    assert not {"link", "commands"} & chosen.keys()


def test_a_group_of_another_verb_is_no_choice_of_this_one(tmp_path: Path) -> None:
    """A user's folder neither: else its folder robot would make deploy take robot=sim for a file."""
    (tmp_path / "robot").mkdir()
    mine = (config_folder() / "robot/go1.yaml").read_text().replace("damping: [0.0", "damping: [0.7")
    (tmp_path / "robot/sim.yaml").write_text(mine)
    assert compose("deploy", ["robot=sim"], [tmp_path])["robot"] == "sim"
    assert compose("train", ["robot=sim"], [tmp_path])["robot"]["damping"] == [0.7, 0.0, 0.0]
