"""The verb ``plot``: pictures of finished runs, for reports."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from depthba.errors import OptionError, RunError
from depthba.verbs import DONE
from depthba.verbs.output import print_json

if TYPE_CHECKING:
    from depthba.plots.source import Source

Kind = Literal["map", "residuals", "trajectory", "covariance", "change"]
OF_ONE: tuple[Kind, ...] = ("map", "residuals", "trajectory", "covariance")
FOLDER = "plots"
SUFFIXES = (".png", ".svg")


@dataclass(frozen=True)
class Arguments:
    """Draw what a run holds: map, residuals, trajectory, covariance, change since another run.

    Writes one picture a kind into the run's folder plots. docs/plots.md says how to read each.
    """

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Folder of a run, as register leaves it."""
    kind: Annotated[tuple[Kind, ...], tyro.conf.arg(metavar="KIND ...")] = ()
    """What to draw: map, residuals, trajectory, covariance; change with --against. None: all four,
    or with --against the change."""
    against: Annotated[Path | None, tyro.conf.arg(metavar="RUN")] = None
    """Folder of an earlier run of the same place, in the same world frame: draw the difference of
    the heights, RUN less this one."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """A file of one picture, .png or .svg; or a folder for several. None: RUN/plots."""
    svg: bool = False
    """Write SVG in place of PNG."""
    as_is: bool = False
    """With --against: leave in the height and tilt by which the two maps differ as wholes."""
    least: Annotated[float | None, tyro.conf.arg(metavar="M")] = None
    """With --against: difference that counts as a change, m. None: five robust standard deviations
    of all differences."""
    dataset: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Folder of the dataset. None: where the run had it."""
    json: bool = False
    """Print one JSON object on stdout in place of text: files and figures, in m, rad, m^2, m^3."""


def run(arguments: Arguments) -> int:
    """Draw the pictures, say where they are, return the exit status."""
    kinds = arguments.kind or (OF_ONE if arguments.against is None else ("change",))
    if ("change" in kinds) != (arguments.against is not None):
        raise OptionError(
            "--kind change goes with --against RUN, the run to compare with, and only with it"
        )
    files = _files(arguments, kinds)
    from depthba.plots.source import Source

    source = Source.open(arguments.run, arguments.dataset)
    told = []
    for kind, path in zip(kinds, files, strict=True):
        path.parent.mkdir(parents=True, exist_ok=True)
        if kind == "change":
            figures = _change(source, arguments, path)
        else:
            figures = _DRAW[kind](source, path)
        told.append({"kind": kind, "file": str(path), **figures})
        if not arguments.json:
            print(path, flush=True)
    if arguments.json:
        print_json({"run": str(arguments.run), "plots": told})
    return DONE


def _files(arguments: Arguments, kinds: tuple[Kind, ...]) -> list[Path]:
    """Return where each picture goes."""
    out = arguments.run / FOLDER if arguments.out is None else arguments.out
    if arguments.out is not None and out.suffix and not out.is_dir():
        if out.suffix.lower() not in SUFFIXES:
            raise OptionError(f"--out {out}: expected {' or '.join(SUFFIXES)}, or a folder")
        if len(kinds) > 1:
            raise OptionError(
                f"--out {out}: is one file for {len(kinds)} pictures, expected a folder, or one "
                "--kind"
            )
        return [out]
    if out.is_file():
        raise RunError(f"{out}: is a file, expected a folder for the plots")
    return [out / f"{kind}{'.svg' if arguments.svg else '.png'}" for kind in kinds]


def _map(source: Source, path: Path) -> dict[str, Any]:
    from depthba.picture import map_picture

    map_picture(source, source.dataset, path, options=source.options, clouds=source.clouds)
    return {"spacing_m": source.depth_map.spacing}


def _residuals(source: Source, path: Path) -> dict[str, Any]:
    from depthba.plots import residuals

    return residuals.draw(source, path)


def _trajectory(source: Source, path: Path) -> dict[str, Any]:
    from depthba.plots import trajectory

    return trajectory.draw(source, path)


def _covariance(source: Source, path: Path) -> dict[str, Any]:
    from depthba.plots import covariance

    return covariance.draw(source, path)


def _change(source: Source, arguments: Arguments, path: Path) -> dict[str, Any]:
    from depthba.plots import change
    from depthba.plots.source import Source

    assert arguments.against is not None
    old = Source.open(arguments.against)
    return change.draw(source, old, path, as_is=arguments.as_is, least=arguments.least)


_DRAW: dict[Kind, Callable[[Source, Path], dict[str, Any]]] = {
    "map": _map,
    "residuals": _residuals,
    "trajectory": _trajectory,
    "covariance": _covariance,
}
