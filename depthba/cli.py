"""The command line: finds a verb by its name, parses its arguments, turns errors into a status.

Nothing heavy is imported before the verb is known, so that ``depthba --help`` answers at once.
"""

from __future__ import annotations

import difflib
import importlib
import importlib.util
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from depthba.errors import DepthbaError, MissingPackage
from depthba.verbs import DONE, INTERRUPTED, KNOWN_ERROR, WRONG_USAGE


@dataclass(frozen=True)
class Verb:
    """Where a verb lives."""

    module: str
    """Holds ``Arguments``, a frozen dataclass, and ``run(arguments) -> int``."""
    help: str
    """One line for the overview."""
    extra: str = ""
    """The extra that brings what the verb needs beyond the base packages."""
    needs: tuple[str, ...] = ()
    """Import names of the packages of that extra that the verb cannot do without."""


VERBS = {
    "demo": Verb(
        "depthba.verbs.demo",
        "Generate, register, evaluate and record one scene, end to end.",
        extra="sim",
        needs=("mujoco", "embreex"),
    ),
    "generate": Verb(
        "sim.verbs.generate",
        "Render a dataset of a simulated scene, with known truth.",
        extra="sim",
        needs=("mujoco", "embreex"),
    ),
    "simulate-controller": Verb(
        "sim.verbs.simulate_controller",
        "Run a simulated UR16e, which a client of the real one can drive.",
        extra="sim",
        needs=("mujoco",),
    ),
    "capture": Verb(
        "rig.verbs.capture",
        "Run a capture session on a rig, or rehearse it without one.",
        extra="rig",
    ),
    "register": Verb(
        "depthba.verbs.register", "Estimate the poses and the depth map of a dataset."
    ),
    "calibrate": Verb(
        "rig.verbs.calibrate", "Estimate where the camera sits on the robot's flange."
    ),
    "evaluate": Verb(
        "eval.verbs.evaluate", "Measure runs against truth, or against themselves without it."
    ),
    "benchmark": Verb(
        "eval.verbs.benchmark",
        "Run every method on every scene: the paper's tables and ours.",
        extra="eval",
        needs=("jinja2", "psutil"),
    ),
    "review": Verb(
        "eval.verbs.review",
        "Open the recordings of runs in the viewer.",
        extra="eval",
        needs=("rerun",),
    ),
    "plot": Verb(
        "depthba.verbs.plot",
        "Draw pictures of a run: map, residuals, trajectory, covariance, change.",
    ),
    "convert": Verb(
        "depthba.verbs.convert",
        "Turn other people's data into datasets, and results into other people's files.",
    ),
    "doctor": Verb("depthba.verbs.doctor", "Check this machine, or a dataset."),
    "completion": Verb(
        "depthba.verbs.completion", "Print the script that lets a shell complete these words."
    ),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status.

    Args:
        argv: the words after the program's name; None takes those of this process.
    """
    try:
        status = _main(list(sys.argv[1:] if argv is None else argv))
        sys.stdout.flush()
        return status
    except KeyboardInterrupt:
        print("depthba: interrupted", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        # the reader of our output has left: nobody is there to be told
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return KNOWN_ERROR
    except Exception as error:
        line = _known(error)
        if line is None:
            raise
        print(f"depthba: error: {' '.join(line.split())}", file=sys.stderr)
        return KNOWN_ERROR


def _main(words: list[str]) -> int:
    if not words or words[0] in ("-h", "--help", "help"):
        print(_overview(), file=sys.stdout if words else sys.stderr)
        return DONE if words else WRONG_USAGE
    name, *rest = words
    if name == "--version":
        from depthba import __version__

        print(f"depthba {__version__}")
        return DONE
    if name not in VERBS:
        near = difflib.get_close_matches(name, VERBS, n=1)
        meant = f"did you mean {near[0]}? The verbs" if near else "the verbs"
        print(f"depthba: no verb {name!r}; {meant} are: {', '.join(VERBS)}", file=sys.stderr)
        return WRONG_USAGE
    verb = VERBS[name]
    if missing := _missing(verb):
        raise MissingPackage(_install_line(name, missing, verb.extra))
    try:
        module = importlib.import_module(verb.module)
        arguments_type: type[object] = module.Arguments
        run: Callable[[object], int] = module.run
        from depthba.verbs.arguments import parse

        return run(parse(arguments_type, rest, prog=f"depthba {name}"))
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package in ("depthba", "sim", "rig", "eval", ""):
            raise
        raise MissingPackage(_install_line(name, package, verb.extra)) from error


def _overview() -> str:
    width = max(map(len, VERBS))
    lines = [
        "usage: depthba VERB [arguments]",
        "",
        "Registers many depth frames of one scene at once: every frame's pose and a depth map.",
        "",
        "first steps:",
        "  depthba demo                                             see it work, end to end",
        "  depthba register my-pngs --intrinsics FX FY CX CY --depth-scale 0.001 --out my-run",
        "                                                           a folder of depth images",
        "  depthba plot my-run                                      pictures of what came out",
        "",
        "verbs:",
    ]
    for name, verb in VERBS.items():
        missing = _missing(verb)
        note = f" (needs {missing}: pip install 'depthba[{verb.extra}]')" if missing else ""
        lines.append(f"  {name:<{width}}  {verb.help}{note}")
    lines += [
        "",
        "options:",
        "  -h, --help     this page; `depthba VERB --help` for the arguments of a verb",
        "  --version      the version of depthba",
        "  --config FILE  (after the verb) defaults from a YAML file; the command line wins",
        "",
        "exit status: 0 done, 1 error, 2 wrong usage, 3 finished but not to be trusted",
    ]
    return "\n".join(lines)


def _missing(verb: Verb) -> str:
    """Return the packages that the verb needs and that are not installed, without importing any."""
    return ", ".join(name for name in verb.needs if importlib.util.find_spec(name) is None)


def _install_line(verb: str, packages: str, extra: str) -> str:
    what = f"depthba[{extra}]" if extra else "depthba"
    return f"{verb} needs {packages}, which is not installed: pip install '{what}'"


def _known(error: Exception) -> str | None:
    """Return the line for an error that is no fault of the program, else None."""
    if isinstance(error, DepthbaError):
        return str(error)
    if isinstance(error, OSError) and error.errno is not None:
        # a missing file, no permission, a full disk
        reason = error.strerror or str(error)
        return reason if error.filename is None else f"{error.filename}: {reason}"
    return None
