"""The methods of the benchmark, by name. Each is imported when it is used."""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Iterable
from dataclasses import dataclass

from depthba.errors import MissingPackage, OptionError
from eval.methods.method import Estimate, Method, MethodError, Stopwatch, Task

__all__ = [
    "METHODS",
    "Entry",
    "Estimate",
    "Method",
    "MethodError",
    "Stopwatch",
    "Task",
    "entry",
    "find_method",
    "in_order",
    "missing",
]


@dataclass(frozen=True)
class Entry:
    """Where a method lives, and what tables call it."""

    label: str
    module: str
    kind: str
    """Name of its dataclass there."""
    needs: tuple[str, ...] = ()
    """Import names of packages beyond the base."""
    ranked: bool = True
    """Whether it takes part in best and second."""


METHODS: dict[str, Entry] = {
    "initial": Entry("Initial", "eval.methods.initial", "Initial", ranked=False),
    "teaser": Entry("TEASER", "eval.methods.chain", "Teaser", ("open3d",)),
    "teaser-icp": Entry("T+ICP", "eval.methods.chain", "TeaserIcp", ("open3d", "small_gicp")),
    "teaser-pgo": Entry("T+PGO", "eval.methods.pose_graph", "TeaserPgo", ("open3d", "gtsam")),
    "teaser-pgo-gnc": Entry(
        "T+PGO (GNC)", "eval.methods.pose_graph", "TeaserPgoGnc", ("open3d", "gtsam")
    ),
    "teaser-ba": Entry("T+BA", "eval.methods.bundle", "TeaserBa", ("open3d",)),
    "balm2": Entry("BALM2", "eval.methods.planes", "Balm2"),
    "balm2-fine": Entry("BALM2 (coarse to fine)", "eval.methods.planes", "Balm2CoarseToFine"),
    "gicp-pgo": Entry("GICP+PGO", "eval.methods.pose_graph", "GicpPgo", ("small_gicp", "gtsam")),
    "kiss": Entry("KISS-Matcher", "eval.methods.chain", "Kiss", ("kiss_matcher",)),
    "open3d-multiway": Entry(
        "Open3D multiway", "eval.methods.multiway", "Open3dMultiway", ("open3d",)
    ),
    "depthba-paper": Entry("depthba (paper)", "eval.methods.ours", "DepthbaPaper"),
    "depthba": Entry("depthba", "eval.methods.ours", "Depthba"),
}
"""In the order of the tables."""


def entry(name: str) -> Entry:
    """Return what is known of a method: one of `METHODS`, or ``module:Class`` of one's own.

    Raises:
        OptionError: there is none of that name.

    """
    if name in METHODS:
        return METHODS[name]
    module, colon, kind = name.partition(":")
    if not (colon and kind.isidentifier() and all(p.isidentifier() for p in module.split("."))):
        choices = ", ".join(METHODS)
        raise OptionError(
            f"method {name!r}: unknown; choose from: {choices}, or name your own as module:Class"
        )
    return Entry(kind, module, kind)


def in_order(names: Iterable[str]) -> list[str]:
    """Return names of methods in the order of the tables, one's own last."""
    there = dict.fromkeys(names)
    return [n for n in METHODS if n in there] + [n for n in there if n not in METHODS]


def missing(name: str) -> tuple[str, ...]:
    """Return the packages that a method needs and that are not installed."""
    return tuple(p for p in entry(name).needs if importlib.util.find_spec(p) is None)


def find_method(name: str) -> Method:
    """Return a method with its usual options.

    Raises:
        OptionError: there is none of that name.
        MissingPackage: a package that it needs is not installed.

    """
    found = entry(name)
    if absent := missing(name):
        raise MissingPackage(
            f"method {name} needs {', '.join(absent)}, which is not installed: "
            "pip install 'depthba[eval]'"
        )
    try:
        method: Method = getattr(importlib.import_module(found.module), found.kind)()
    except (ImportError, AttributeError) as error:
        raise OptionError(f"method {name!r}: cannot be loaded: {error}") from error
    return method
