"""A page about one run, for people."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from eval.metrics import Metric, split

if TYPE_CHECKING:
    from eval.evaluate import Evaluation

NAMES = {
    "translation_mae": "Translation, mean absolute error",
    "translation_rmse": "Translation, root mean square",
    "translation_max": "Translation, largest",
    "rotation_mae": "Rotation, mean absolute error",
    "rotation_rmse": "Rotation, root mean square",
    "rotation_max": "Rotation, largest",
    "ate_rmse": "Trajectory after best alignment (ATE)",
    "rpe_translation_rmse": "Motion between frames, translation (RPE)",
    "rpe_rotation_rmse": "Motion between frames, rotation (RPE)",
    "translation_bound": "Translation, least possible (Cramér-Rao bound)",
    "rotation_bound": "Rotation, least possible (Cramér-Rao bound)",
    "translation_over_bound": "Translation, error over the bound",
    "rotation_over_bound": "Rotation, error over the bound",
    "nees_per_dof": "Error over stated covariance (NEES per degree of freedom)",
    "map_rmse": "Map against true surface, root mean square",
    "map_p95": "Map against true surface, 95 % of nodes",
    "map_complete_1x": "Map right to one node spacing, share of nodes",
    "map_complete_2x": "Map right to two node spacings, share of nodes",
    "map_complete_5x": "Map right to five node spacings, share of nodes",
    "cloud_to_cloud": "Map to true surface, mean distance",
    "chamfer": "Map and true surface, distances both ways (Chamfer)",
    "marker_error_x": "Distance of markers along X",
    "marker_error_y": "Distance of markers along Y",
    "spread_median": "Disagreement of frames, median cell",
    "spread_p90": "Disagreement of frames, 90 % of cells",
    "point_to_plane_median": "Point to plane between frames, median pair",
    "point_to_plane_worst_pair": "Point to plane between frames, worst pair",
    "same_face_median": "Point to plane, same side of walls, median pair",
    "patch_thickness": "Thickness of planar patches, median",
    "mean_map_entropy": "Mean map entropy (lengths in metres)",
}
"""The metrics that a table for people shows, in its order; the others are per axis."""

SHORT_NAMES = {
    "translation_mae": "Translation error",
    "rotation_mae": "Rotation error",
    "ate_rmse": "Trajectory error (ATE)",
    "map_rmse": "Map error",
    "marker_error_x": "Marker distance X",
    "marker_error_y": "Marker distance Y",
    "spread_median": "Frames disagree, median",
    "spread_p90": "Frames disagree, 90 %",
    "point_to_plane_median": "Point to plane",
    "nees_per_dof": "NEES (1 is honest)",
}
"""The same for where there is little room."""

SURFACES = {
    "clean": "The bound knows the surface without noise.",
    "noisy": "The bound takes the surface fitted to the noisy frames at the true poses, "
    "less what noise adds to the slopes.",
}
"""Where the bound takes the surface from."""

MOST_LINES = 6
"""Of what is open or held, on a page with little room."""

VERDICTS = {
    "converged": "Converged",
    "not_converged": "Not to be trusted: not converged",
    "weak": "Not to be trusted everywhere: the data leave something open",
    "no_better": "Not to be trusted: nothing better than the start poses was found",
}


def report(judged: Evaluation) -> str:
    """Return report.md: verdict, figures, picture, what is weak, the frames, how it was run."""
    run = judged.run.result
    parts = [
        f"# {judged.run.name}",
        _verdict(run),
        "![The map and the disagreement of frames, before and after](map.png)",
        "## Before and after",
        figures_table(judged.metrics, judged.start_metrics),
        _explanation(judged),
        *_axes(judged),
        *_weak(run["weak"]),
        *_held_frames(run["frames"]),
        "## Frames",
        _frames(run["frames"]),
        "## How it was run",
        _facts(judged),
        "Files: [result.json](result.json), [poses.txt](poses.txt), [metrics.json](metrics.json), "
        "map.npz, covariance.npz, cloud.ply. `depthba review` opens the recording.",
    ]
    return "\n\n".join(parts) + "\n"


def figures_page(run: Mapping[str, Any], metrics: Sequence[Metric]) -> str:
    """Return a short page in Markdown for beside the pictures.

    Args:
        run: what result.json holds.
        metrics: as `eval.evaluate.evaluate` returns them, or none.

    """
    parts = [f"### {run['name']}", _verdict(run)]
    if metrics:
        estimate, before = ({m.name: m for m in ms} for ms in split(metrics))
        rows = [
            [words, show(before[n]) if n in before else "", f"**{show(estimate[n])}**"]
            for n, words in SHORT_NAMES.items()
            if n in estimate
        ]
        parts.append(_table(["", "Start", "depthba"], rows))
    else:
        parts.append("Not judged yet: `depthba evaluate` adds the figures.")
    open_ones = [
        f"- frame {w['frame']} is held along {w['name']} by its measured pose" for w in run["weak"]
    ]
    open_ones += [f"- frame {f['frame']} is held: {f['held']}" for f in _held(run["frames"])]
    if len(open_ones) > MOST_LINES:
        more = len(open_ones) - MOST_LINES
        open_ones = [*open_ones[:MOST_LINES], f"- and {more} more, see report.md"]
    if open_ones:
        parts.append("\n".join(open_ones))
    seconds = run["seconds"].get("total", sum(run["seconds"].values()))
    parts.append(
        f"{len(run['frames'])} frames, {run['iterations']} iterations, {three_digits(seconds)} s, "
        f"map spacing {_mm(run['map']['spacing'])}"
    )
    return "\n\n".join(parts) + "\n"


Row = tuple[str, Sequence[Metric], str, float | None, int | None]
"""A run in a comparison: label, figures, status, seconds, iterations."""

COMPARED = {
    "translation_mae": "Translation error",
    "rotation_mae": "Rotation error",
    "ate_rmse": "Trajectory (ATE)",
    "spread_median": "Frames disagree, median",
    "spread_p90": "90 %",
}
"""The figures that runs are compared by."""


def comparison_page(name: str, rows: Sequence[Row]) -> str:
    """Return a short page in Markdown: one line for each run, the best of each figure in bold."""
    figures = [{m.name: m for m in metrics} for _, metrics, *_ in rows]
    names = [n for n in COMPARED if any(n in f for f in figures)]
    best = {n: min((f[n].value for f in figures if n in f), default=np.nan) for n in names}
    lines = []
    for (label, _, status, seconds, iterations), found in zip(rows, figures, strict=True):
        cells = []
        for n in names:
            text = show(found[n]) if n in found else ""
            cells.append(f"**{text}**" if text and found[n].value == best[n] else text)
        cells.append("" if iterations is None else str(iterations))
        cells.append("" if seconds is None else f"{three_digits(seconds)} s")
        lines.append([label, *cells, status.replace("_", " ")])
    head = [name, *(COMPARED[n] for n in names), "Iterations", "Time", "Status"]
    return _table(head, lines) + "\n"


def figures_table(metrics: Sequence[Metric], start_metrics: Sequence[Metric]) -> str:
    """Return a Markdown table of the figures that count, start beside estimate."""
    before = {m.name: m for m in start_metrics}
    now = {m.name: m for m in metrics}
    rows = []
    for name, words in NAMES.items():
        if name not in now:
            continue
        first = show(before[name]) if name in before else ""
        rows.append([words, first, f"**{show(now[name])}**", gain(before.get(name), now[name])])
    return _table(["", "Start poses", "depthba", "Better by"], rows)


def _verdict(run: Mapping[str, Any]) -> str:
    reason = str(run["reason"])
    return f"**{VERDICTS.get(run['status'], run['status'])}.** {reason[:1].upper()}{reason[1:]}."


def show(metric: Metric) -> str:
    """Return a value for people, three digits: millimetres, milliradians or a bare number."""
    unit = {"m": " mm", "rad": " mrad", "1": ""}[metric.unit]
    value = metric.value if metric.unit == "1" else 1e3 * metric.value
    return "unknown" if not np.isfinite(value) else f"{three_digits(value)}{unit}"


def three_digits(value: float) -> str:
    """Return a number with three digits and no exponent; the far end of small ones is cut."""
    if not value:
        return "0"
    digits = 2 - int(np.floor(np.log10(abs(value))))
    return f"{value:.{min(max(digits, 0), 5)}f}"


def gain(before: Metric | None, now: Metric) -> str:
    """Return by what factor an error fell; empty where that means nothing."""
    if before is None or not (before.value > 0 and now.value > 0):
        return ""
    factor = before.value / now.value
    return f"{three_digits(factor)} ×" if factor < 1000 else f"{factor:.0f} ×"


def against(judged: Evaluation) -> str:
    """Return what the errors are measured against, for how many frames."""
    known, count = judged.true_frames, len(judged.run.stamps)
    if not known:
        return "There is no truth: the figures say how well the frames agree."
    text = f"Errors are against the truth, frame {known[0]} put onto it."
    if len(known) < count:
        text += f" {len(known)} of {count} frames have truth; the others count in no error."
    return text


def _explanation(judged: Evaluation) -> str:
    text = (
        f"Frames are compared in cells of {three_digits(1e3 * judged.cell)} mm; two or more frames "
        f"see {judged.shared_cells} of them, and {judged.pairs} pairs of frames overlap."
    )
    text = f"{against(judged)} {text}"
    if judged.nees_dof is not None:
        text += (
            f" NEES is over {judged.nees_dof} degrees of freedom: 1 is an honest covariance, "
            "above it is too sure of itself."
        )
    if judged.bound is not None:
        text += (
            " The bound is the least mean absolute error with range noise of "
            f"{_mm(judged.bound.sigma)} and a map of {_mm(judged.bound.spacing)} spacing. "
            f"{SURFACES[judged.bound.surface]}"
        )
    return text


def _axes(judged: Evaluation) -> list[str]:
    """Return the mean absolute errors per axis, where there is truth."""
    now = {m.name: m for m in judged.metrics}
    if "translation_mae_x" not in now:
        return []
    before = {m.name: m for m in judged.start_metrics}
    rows = []
    for part in ("translation", "rotation"):
        for axis in "xyz":
            name = f"{part}_mae_{axis}"
            rows.append([f"{part} {axis}", show(before[name]), show(now[name])])
    return ["Mean absolute error per axis of the world:", _table(["", "Start", "depthba"], rows)]


def _weak(weak: Sequence[dict[str, Any]]) -> list[str]:
    if not weak:
        return []
    rows = [
        [
            str(w["frame"]),
            w["name"],
            _mm(w["sigma"]),
            _mm(w["prior_sigma"]),
        ]
        for w in weak
    ]
    return [
        "## Weak directions",
        "The data do not fix these motions, so the measured poses hold them.",
        _table(["Frame", "Direction (map axes)", "Data alone leave", "Measured pose gives"], rows),
    ]


def _held(frames: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the frames that were held; not the first, which fixes the frame of reference."""
    return [f for f in frames[1:] if f["held"]]


def _held_frames(frames: Sequence[dict[str, Any]]) -> list[str]:
    held = [f"- frame {f['frame']}: {f['held']}" for f in _held(frames)]
    return ["## Frames held at their start poses", "\n".join(held)] if held else []


def _frames(frames: Sequence[dict[str, Any]]) -> str:
    rows = [
        [
            str(f["frame"]),
            str(f["points"]),
            _percent(f["overlap"]),
            _percent(f["inliers"]),
            _mm(f["move_t"]),
            _mrad(f["move_r"]),
            ("" if k else "fixed") if not f["held"] or not k else "held",
        ]
        for k, f in enumerate(frames)
    ]
    head = ["Frame", "Points", "Overlap", "Inliers", "Moved", "Turned", ""]
    return _table(head, rows)


def _facts(judged: Evaluation) -> str:
    run, options = judged.run.result, judged.run.config
    stages = ", ".join(f"{k} {three_digits(v)} s" for k, v in run["seconds"].items())
    noise = (
        f"{_mm(run['sigma'])}; inflation of the covariance by correlation {run['inflation']:.3g}"
    )
    if run.get("fixed_pattern"):
        noise += f"; fixed pattern of the camera {_mm(run['fixed_pattern'])} rms, taken off"
    if run.get("refused_pattern"):
        noise += f"; a pattern of {_mm(run['refused_pattern'])} rms would fit: too much, left in"
    rows = [
        ["Dataset", f"{judged.dataset.name}, {len(judged.run.stamps)} frames"],
        ["Preset", str(options.get("preset"))],
        [
            "Map",
            f"{run['map']['nx']} × {run['map']['ny']} nodes, {_mm(run['map']['spacing'])} apart",
        ],
        ["Iterations", str(run["iterations"])],
        ["Seconds", stages],
        ["Residuals, robust standard deviation", noise],
        ["Versions", ", ".join(f"{k} {v}" for k, v in run["versions"].items())],
    ]
    if judged.dataset.seed is not None:
        rows.insert(1, ["Seed", str(judged.dataset.seed)])
    if options.get("roi"):
        rows.insert(3, ["Region of interest (m)", " ".join(f"{v:g}" for v in options["roi"])])
    return _table(["", ""], rows)


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table; the first column to the left, the others to the right."""
    lines = [head, ["---", *["---:"] * (len(head) - 1)], *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "/") for cell in r) + " |" for r in lines)


def _mm(metres: float | None) -> str:
    return "unknown" if metres is None else f"{three_digits(1e3 * metres)} mm"


def _mrad(radians: float | None) -> str:
    return "unknown" if radians is None else f"{three_digits(1e3 * radians)} mrad"


def _percent(share: float | None) -> str:
    return "unknown" if share is None else f"{100 * share:.0f} %"
