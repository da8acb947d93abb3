"""How a recording opens in the viewer: which views, where, and seen from where."""

from __future__ import annotations

import colorsys

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from depthba.depth_map import DepthMap

Floats = NDArray[np.float64]

BACKGROUND = (24, 26, 30)
TAN_HALF_VIEW = 0.55
"""Tangent of half the angle that the viewer's eye takes in, in height."""


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


def blueprint(depth_map: DepthMap, T_world_camera: Floats, *, truth: bool) -> rrb.Blueprint:
    """Arrange the views: before on the left, after in the middle, figures and map on the right.

    Args:
        depth_map: the final map, whose axes and extent say where to look from.
        T_world_camera: (N, 4, 4), the final poses, which should be seen.
        truth: whether there are curves of errors.

    """
    centres = T_world_camera[:, :3, 3]
    before = rrb.Vertical(
        _scene(
            "BEFORE: frames at their start poses",
            ["/before/**", "/centres/start"],
            depth_map,
            centres,
        ),
        _above("BEFORE: how far the frames disagree", "/spread/before"),
        row_shares=[3, 2],
    )
    after = rrb.Vertical(
        _scene(
            "AFTER: frames as depthba places them", ["/cam/**", "/centres/**"], depth_map, centres
        ),
        _above("AFTER: how far the frames disagree", "/spread/after"),
        row_shares=[3, 2],
    )
    curves = [
        _curves("Residual of each frame (mm)", "/residual"),
        _curves("Robust sigma of the residuals (mm)", "/curves/sigma"),
        _curves("Step (log10 of mm and mrad)", "/curves/step"),
        _curves("Cost (log10)", "/curves/cost"),
        _curves("Inliers (%)", "/curves/inliers"),
        _curves("Map spacing (mm)", "/curves/spacing"),
    ]
    if truth:
        curves.insert(0, _curves("Error against truth (mm and mrad)", "/curves/error"))
    told = rrb.Vertical(
        rrb.TextDocumentView(origin="/figures", name="Figures"),
        rrb.Tabs(
            _scene("Map", ["/map/surface"], depth_map, np.zeros((0, 3)), wide=2.2),
            _above("Map from above", "/map/picture"),
        ),
        rrb.Tabs(*curves, active_tab=0),
        row_shares=[6, 4, 4],
    )
    return rrb.Blueprint(
        rrb.Horizontal(before, after, told, column_shares=[5, 5, 5]),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="iteration", fps=4.0, play_state="following"),
        auto_views=False,
        auto_layout=False,
    )


def _scene(
    name: str, contents: list[str], depth_map: DepthMap, centres: Floats, wide: float = 1.1
) -> rrb.Spatial3DView:
    """Return a view from above and in front, from where the map and the cameras are all seen.

    The pane is about ``wide`` times as wide as it is high.
    """
    vertices = depth_map.vertices().reshape(-1, 3)
    vertices = vertices[np.isfinite(vertices).all(axis=1)]
    if not len(vertices):
        return rrb.Spatial3DView(origin="/", contents=contents, name=name)
    across, along, up = depth_map.T_map_world[:3, :3]
    back = 0.8 * up - 0.6 * along
    seen = np.concatenate([vertices, centres])
    target = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    # the nearest place on that line from which every point lies within the view's angle
    depth, side, rise = ((seen - target) @ axis for axis in (back, across, np.cross(back, across)))
    distance = 1.08 * np.max(depth + np.maximum(np.abs(side) / wide, np.abs(rise)) / TAN_HALF_VIEW)
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


def _above(name: str, origin: str) -> rrb.Spatial2DView:
    return rrb.Spatial2DView(origin=origin, name=name, contents=["$origin/**"])


def _curves(name: str, origin: str) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        origin=origin,
        name=name,
        plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop, visible=origin != "/residual"),
        axis_x=rrb.TimeAxis(link=rr.blueprint.components.LinkAxis.Independent),
    )
