"""The methods of the benchmark, by name. Each is imported when it is used."""

from __future__ import annotations

import importlib
import importlib.util
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
    "find_method",
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
    "balm2": Entry("BALM2", "eval.methods.planes", "Balm2", ("open3d",)),
    "balm2-fine": Entry(
        "BALM2 (coarse to fine)", "eval.methods.planes", "Balm2CoarseToFine", ("open3d",)
    ),
    "gicp-pgo": Entry("GICP+PGO", "eval.methods.pose_graph", "GicpPgo", ("small_gicp", "gtsam")),
    "kiss": Entry("KISS-Matcher", "eval.methods.chain", "Kiss", ("kiss_matcher",)),
    "open3d-multiway": Entry(
        "Open3D multiway", "eval.methods.multiway", "Open3dMultiway", ("open3d",)
    ),
    "depthba-paper": Entry("depthba (paper)", "eval.methods.ours", "DepthbaPaper"),
    "depthba": Entry("depthba", "eval.methods.ours", "Depthba"),
}
"""In the order of the tables."""


def missing(name: str) -> tuple[str, ...]:
    """Return the packages that a method needs and that are not installed."""
    return tuple(p for p in METHODS[name].needs if importlib.util.find_spec(p) is None)


def find_method(name: str) -> Method:
    """Return a method with its usual options.

    Raises:
        OptionError: there is none of that name.
        MissingPackage: a package that it needs is not installed.

    """
    if name not in METHODS:
        raise OptionError(f"method {name!r}: unknown; choose from: {', '.join(METHODS)}")
    if absent := missing(name):
        raise MissingPackage(
            f"method {name} needs {', '.join(absent)}, which is not installed: "
            "pip install 'depthba[eval]'"
        )
    entry = METHODS[name]
    method: Method = getattr(importlib.import_module(entry.module), entry.kind)()
    return method
