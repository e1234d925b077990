"""The words of the command line: verbs, their second words, settings by position, Hydra's options."""

from __future__ import annotations

VERBS = {
    "train": "train a policy from configuration",
    "tune": "search for settings of a training, several at once, the hopeless ones ended early",
    "eval": "run a trained policy through a grid of commands: errors, falls, a table and JSON",
    "compare": "compare policies on the same protocol and robots: paired differences, a page and JSON",
    "report": "training runs together: learning curves, intervals over seeds, verdicts against a baseline",
    "play": "watch a trained policy: a clip without a display, a live viewer with one",
    "record": "drive the simulated robot and log it; audit recordings, import others",
    "gap": "find where simulation and recordings disagree, name the missing effect, add it",
    "export": "pack a trained policy into one sealed file for the robot; check such a file",
    "deploy": "run a bundle's policy in real time on a robot, or on a simulated one in another process",
    "sim": "the simulated robot alone, for any client that speaks the Go1's protocol",
    "fit-actuator": "learn an actuator net from recordings",
    "list": "list terms, groups and their choices, one line each",
    "bench": "measure speed as ratios in one run",
}
"""Verb -> one line; the module has the verb's name (``list`` is ``listing``)."""

MODULES = {"eval": "evaluate", "fit-actuator": "fit_actuator", "list": "listing", "sim": "simulate"}
"""Modules that cannot have their verb's name."""

SUBVERBS = {"record": ("audit", "import"), "export": ("check",), "gap": ("next", "loop")}
"""Second words of a verb that are verbs of their own; module and configuration are called VERB_WORD."""

POSITIONAL: dict[str, tuple[str, ...]] = {
    "record_audit": ("files",),
    "record_import": ("source", "path"),
    "export_check": ("file",),
    "gap": ("stage",),
    "deploy": ("bundle",),
    "list": ("group",),
    "compare": ("subjects",),
    "report": ("folders",),
}
"""Settings that may be given by position alone; those of ``LISTS`` take all that are left."""

LISTS = ("files", "subjects", "folders")

VALUED = ("--cfg", "-c", "--info", "-i", "--package", "-p", "--config-dir", "-cd", "--config-name", "-cn")
"""Options of Hydra whose value is the word after them."""

FLAGS = (
    *("--hydra-help", "--version", "--resolve", "--run", "-r", "--multirun", "-m"),
    *("--config-path", "-cp", "--experimental-rerun"),
)
"""Hydra's other options."""

ONE_BLAS_THREAD = ("OPENBLAS_NUM_THREADS", "1")
"""Variable and value, read when NumPy is first imported: its matrices are small here, and threads that wait for each
other spin. On two busy cores matrix products of ``go1exp gap`` took 40 times as long with two threads as with one."""
