"""How a recording opens in the viewer: which views, where, and seen from where."""

from __future__ import annotations

import colorsys
from collections.abc import Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from depthba.depth_map import DepthMap
from eval.recorded_certainty import Scale

Floats = NDArray[np.float64]

BACKGROUND = (24, 26, 30)
TAN_HALF_VIEW = 0.55
"""Tangent of half the angle that the viewer's eye takes in, in height."""

ABREAST = 4
"""Runs that are compared in columns; more are too narrow."""
BY_RESIDUAL = "By residual: blue below, red above"


def frame_colours(count: int) -> NDArray[np.uint8]:
    """Return (count, 3) colours, of which consecutive ones are far apart."""
    golden = 0.381966
    return np.array(
        [
            [
                round(255 * c)
                for c in colorsys.hsv_to_rgb((i * golden) % 1.0, 0.62, (1.0, 0.85)[i % 2])
            ]
            for i in range(count)
        ],
        dtype=np.uint8,
    ).reshape(count, 3)


def blueprint(
    depth_map: DepthMap, T_world_camera: Floats, *, truth: bool, scale: Scale
) -> rrb.Blueprint:
    """Arrange a finished run: before, after, how good and how certain, and the figures.

    Args:
        depth_map: the final map, whose axes and extent say where to look from.
        T_world_camera: (N, 4, 4), the final poses, which should be seen.
        truth: whether there are curves of errors.
        scale: how the certainty was drawn.

    """
    n, centres = len(T_world_camera), T_world_camera[:, :3, 3]
    nobody = np.zeros((0, 3))
    before = rrb.Vertical(
        scene(
            "BEFORE, by frame",
            ["/before/**", "/centres/start"],
            depth_map,
            centres,
        ),
        above("BEFORE: how far the frames disagree", "/spread/before"),
        row_shares=[3, 2],
    )
    after = rrb.Vertical(
        scene(
            "AFTER, by frame (white: true centres)" if truth else "AFTER, by frame",
            [*parts_of("/cam", n, "points", "image"), "/centres/**"],
            depth_map,
            centres,
        ),
        above("AFTER: how far the frames disagree", "/spread/after"),
        row_shares=[3, 2],
    )
    good = rrb.Vertical(
        scene(BY_RESIDUAL, parts_of("/cam", n, "residual"), depth_map, centres),
        rrb.Tabs(
            scene(
                _certainty_title(scale),
                ["/certainty/surface", "/certainty/ellipsoids", "/certainty/open"],
                depth_map,
                centres,
                wide=1.3,
            ),
            above("Uncertain cells", "/certainty/picture"),
            active_tab=0,
        ),
        row_shares=[3, 2],
    )
    told = rrb.Vertical(
        rrb.TextDocumentView(origin="/figures", name="Figures"),
        rrb.Tabs(
            scene("Map", ["/map/surface"], depth_map, nobody, wide=1.9),
            above("Map from above", "/map/picture"),
            active_tab=0,
        ),
        _residual_tabs(truth),
        row_shares=[6, 3, 4],
    )
    return _whole(rrb.Horizontal(before, after, good, told, column_shares=[5, 5, 5, 5]))


def live_blueprint(depth_map: DepthMap, T_world_camera: Floats, *, truth: bool) -> rrb.Blueprint:
    """Arrange a run while it goes on, of which there are only states and curves."""
    n, centres = len(T_world_camera), T_world_camera[:, :3, 3]
    return _whole(
        rrb.Horizontal(
            scene(
                "Frames, step by step",
                [*parts_of("/cam", n, "points", "image"), "/centres/true"],
                depth_map,
                centres,
            ),
            scene(BY_RESIDUAL, parts_of("/cam", n, "residual"), depth_map, centres),
            rrb.Vertical(above("Map from above", "/map/picture"), _residual_tabs(truth)),
        )
    )


def capture_blueprint() -> rrb.Blueprint:
    """Arrange a capture session: the frames in the room, what the camera sees, what is told."""
    return _whole(
        rrb.Horizontal(
            rrb.Spatial3DView(
                origin="/",
                contents=["/cam/**", "/path/**"],
                name="Frames by colour, and the way of the camera",
                background=rrb.Background(color=BACKGROUND, kind=rrb.BackgroundKind.SolidColor),
                line_grid=rrb.LineGrid3D(visible=False),
            ),
            rrb.Vertical(
                above("The camera's last image", "/last/rgb"),
                above("Its depth", "/last/depth"),
                rrb.TextDocumentView(origin="/figures", name="Session"),
                row_shares=[3, 3, 2],
            ),
            column_shares=[3, 2],
        )
    )


def compare_blueprint(
    labels: Sequence[str], depth_map: DepthMap, T_world_camera: Floats
) -> rrb.Blueprint:
    """Arrange several placements of the same frames side by side, over a table.

    Up to `ABREAST` stand abreast, with clouds, disagreement and map of each below each other;
    more share tabs.

    Args:
        labels: what the placements are called; the k-th is recorded under ``/run/<k>``.
        depth_map: a map of the scene, whose axes and extent say where to look from.
        T_world_camera: (N, 4, 4), cameras that should be seen.

    """
    n, centres = len(T_world_camera), T_world_camera[:, :3, 3]

    def clouds(k: int, kind: str, name: str) -> rrb.Spatial3DView:
        contents = parts_of(f"/run/{k}/cam", n, kind, "image")
        return scene(name, contents, depth_map, centres, wide=1.5)

    table = rrb.TextDocumentView(origin="/figures", name="Figures")
    if len(labels) <= ABREAST:
        columns = [
            rrb.Vertical(
                rrb.Tabs(
                    clouds(k, "points", label.upper()),
                    clouds(k, "residual", "by residual"),
                    active_tab=0,
                ),
                rrb.Horizontal(
                    above("frames disagree by", f"/run/{k}/spread"),
                    above("map", f"/run/{k}/picture"),
                ),
                row_shares=[5, 4],
            )
            for k, label in enumerate(labels)
        ]
        lines = len(labels) + 1
        shares = [1.0, (90 + 24 * lines) / (770 - 24 * lines)]  # of 860 points of height
        return _whole(rrb.Vertical(rrb.Horizontal(*columns), table, row_shares=shares), time=False)
    kinds = rrb.Tabs(
        rrb.Grid(*(clouds(k, "points", x) for k, x in enumerate(labels)), name="Clouds by frame"),
        rrb.Grid(*(clouds(k, "residual", x) for k, x in enumerate(labels)), name="By residual"),
        rrb.Grid(
            *(above(x, f"/run/{k}/spread") for k, x in enumerate(labels)), name="Disagreement"
        ),
        rrb.Grid(*(above(x, f"/run/{k}/picture") for k, x in enumerate(labels)), name="Maps"),
        active_tab=0,
    )
    return _whole(rrb.Horizontal(kinds, table, column_shares=[2, 1]), time=False)


def _whole(views: rrb.Container, *, time: bool = True) -> rrb.Blueprint:
    """Return a blueprint without the viewer's own panels; with ``time``, steps can be gone by."""
    panel = rrb.TimePanel(
        state="collapsed" if time else "hidden",
        timeline="iteration",
        fps=4.0,
        play_state="following",
    )
    return rrb.Blueprint(
        views,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        panel,
        auto_views=False,
        auto_layout=False,
    )


def _residual_tabs(truth: bool) -> rrb.Tabs:
    """Return the residuals' histograms and all curves, one at a time."""
    curves = [
        rrb.BarChartView(
            origin="/histogram",
            name="Residuals of each frame (-3 to 3 σ)",
            plot_legend=rrb.PlotLegend(visible=False),
        ),
        _curves("Cost (log10)", "/curves/cost"),
        _curves("Residual of each frame (mm)", "/residual"),
        _curves("Robust sigma of the residuals (mm)", "/curves/sigma"),
        _curves("Step (log10 of mm and mrad)", "/curves/step"),
        _curves("Inliers (%)", "/curves/inliers"),
        _curves("Map spacing (mm)", "/curves/spacing"),
    ]
    if truth:
        curves.insert(1, _curves("Error against truth (mm and mrad)", "/curves/error"))
    return rrb.Tabs(*curves, active_tab=0)


def _certainty_title(scale: Scale) -> str:
    """Say what is seen, and how many times larger than it is."""
    title = "Certainty"
    if scale.factor:
        title += f": σ × {scale.factor:g}"
    if scale.cut:
        title += f" ({scale.cut} red: cut)"
    if scale.open_directions:
        title += ", arrows: open"
    return title


def parts_of(root: str, count: int, *names: str) -> list[str]:
    """Return the paths of some parts of all frames: a star within a path finds nothing."""
    return [f"{root}/{i}/{name}" for i in range(count) for name in names]


def scene(
    name: str, contents: list[str], depth_map: DepthMap, centres: Floats, wide: float = 0.85
) -> rrb.Spatial3DView:
    """Return a view from above and in front, from where the map and the cameras are all seen.

    The pane is about ``wide`` times as wide as it is high.
    """
    vertices = depth_map.vertices()[_well_seen(depth_map)].reshape(-1, 3)
    vertices = vertices[np.isfinite(vertices).all(axis=1)]
    if not len(vertices):
        return rrb.Spatial3DView(origin="/", contents=contents, name=name)
    across, along, up = depth_map.T_map_world[:3, :3]
    back = 0.8 * up - 0.6 * along
    seen = np.concatenate([vertices, centres])
    target = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    # the nearest place on that line from which every point lies within the view's angle
    depth, side, rise = ((seen - target) @ axis for axis in (back, across, np.cross(back, across)))
    distance = 1.12 * np.max(depth + np.maximum(np.abs(side) / wide, np.abs(rise)) / TAN_HALF_VIEW)
    return rrb.Spatial3DView(
        origin="/",
        contents=contents,
        name=name,
        background=rrb.Background(color=BACKGROUND, kind=rrb.BackgroundKind.SolidColor),
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital,
            position=target + distance * back,
            look_target=target,
            eye_up=up,
        ),
    )


def _well_seen(depth_map: DepthMap) -> tuple[slice, slice]:
    """Return the rows and columns that most points bear on, and as much around as fits a plane.

    What a few rays met far away, such as the floor beside a table, must not make the rest small.
    """
    spans = []
    for axis in (1, 0):
        share = np.cumsum(depth_map.count.sum(axis=axis, dtype=np.float64))
        if not len(share) or share[-1] <= 0:
            return slice(None), slice(None)
        low, high = np.searchsorted(share / share[-1], (0.1, 0.9))
        more = 0.25 * (high - low) + 1  # of evenly seen ground an eighth lies beyond either end
        spans.append(slice(max(int(low - more), 0), int(high + more) + 1))
    return spans[0], spans[1]


def above(name: str, origin: str) -> rrb.Spatial2DView:
    """Return a view of the picture recorded at ``origin``."""
    return rrb.Spatial2DView(origin=origin, name=name, contents=["$origin/**"])


def _curves(name: str, origin: str) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        origin=origin,
        name=name,
        plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop, visible=origin != "/residual"),
        axis_x=rrb.TimeAxis(link=rr.blueprint.components.LinkAxis.Independent),
    )
