"""The verb ``completion``: scripts with which shells complete the command line."""

from __future__ import annotations

import importlib
from collections.abc import Container
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import tyro

from depthba.verbs import DONE
from depthba.verbs.output import note, print_json

Shell = Literal["bash", "zsh", "fish"]


@dataclass(frozen=True)
class Arguments:
    """Print the script that lets a shell complete verbs, options and their choices.

    Put it where the shell looks, once, and again after an upgrade, for example
    `depthba completion bash > ~/.local/share/bash-completion/completions/depthba`; bash looks there
    with its package bash-completion. Without: `source <(depthba completion bash)` in ~/.bashrc.
    """

    shell: Annotated[Shell, tyro.conf.Positional, tyro.conf.arg(metavar="bash|zsh|fish")]
    """The shell to print it for."""
    json: bool = False
    """Print one JSON object on stdout in place of the script: shell, script."""


def run(arguments: Arguments) -> int:
    """Print the script, made from the parsers of all verbs that can be imported here."""
    from depthba.cli import VERBS
    from depthba.verbs.arguments import completion

    kinds: dict[str, type[Any]] = {}
    for name, verb in VERBS.items():
        try:
            kinds[name] = importlib.import_module(verb.module).Arguments
        except ModuleNotFoundError as error:
            note(f"note: {name} is left out, it needs {error.name}: depthba[{verb.extra}]")
    script = completion(kinds, "depthba", arguments.shell, _known(kinds))
    if arguments.json:
        print_json({"shell": arguments.shell, "script": script})
    else:
        print(script, flush=True)
    return DONE


def _known(verbs: Container[str]) -> dict[str, dict[str, list[str]]]:
    """Return the names that options and arguments of free text take, by verb."""
    from depthba.convert.exporting import OURS, RESULTS
    from depthba.convert.registry import formats

    readable = [one.name for one in formats() if one.read is not None]
    written = [one.name for one in formats() if one.write is not None]
    to = list(dict.fromkeys([OURS, *written, *(one.name for one in RESULTS)]))
    known = {"register": {"--kind": readable}, "convert": {"--kind": readable, "--to": to}}
    if "generate" in verbs:
        from sim.scenes import SCENES

        known["generate"] = {"": list(SCENES)}
    return known
