"""The tab of the look: surface, resolution, colours and what is shown beside it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from snarfcli.viewer.inputs import Inputs
from snarfcli.viewer.picture import RESOLUTIONS, SURFACE_NAMES
from snarfcli.viewer.scene import ViewerScene
from snarfcli.viewer.state import ViewerState

__all__ = ["LookTab"]


class LookTab:
    """The inputs of the look, added to the current container of viser.

    Args:
        inputs: makes the inputs.
        state: state of the viewer.
        scene: scene of the viewer.
    """

    def __init__(self, inputs: Inputs, state: ViewerState, scene: ViewerScene) -> None:
        look = state.look
        has_weights = state.body.has_weights
        surfaces = SURFACE_NAMES if has_weights else ("field",)
        surface = inputs.add_dropdown(
            "Surface", surfaces, look.surface, hint="skinned: at once; field: exact where the body meets itself"
        )
        self._skinned_resolution, self._field_resolution = (
            inputs.add_dropdown("Resolution", list(map(str, sorted({*RESOLUTIONS, number}))), str(number))
            for number in (look.skinned_resolution, look.field_resolution)
        )
        self._show_resolution(look.surface)
        pose_shape = inputs.add_checkbox("Shape of the pose", look.has_pose_shape, hint="or that of the canonical pose")
        weights = inputs.add_checkbox("Weights in colour", look.weight_colors)
        canonical = inputs.add_checkbox("Canonical shape beside it", look.shows_canonical)
        skeleton = inputs.add_checkbox("Skeleton", look.shows_skeleton, hint="click a joint to choose it")
        handle_box = inputs.add_checkbox("Handle at the joint", False, hint="turn the chosen joint in the picture")
        wireframe = inputs.add_checkbox("Wireframe", False)
        color = inputs.add_rgb("Body", scene.body_color)
        inputs.add_button("Frame the body", lambda client: scene.frame_body(client.camera), icon="focus-2")
        for box in (pose_shape, weights, canonical):
            box.visible = has_weights

        def change(name: str, convert: Callable[[Any], Any] = lambda value: value) -> Callable[[Any], None]:
            return lambda value: state.change_look(**{name: convert(value)})

        def change_surface(value: str) -> None:
            self._show_resolution(value)
            state.change_look(surface=value)

        def change_handle(value: bool) -> None:
            scene.shows_handle = value
            if value and not skeleton.value:
                skeleton.value = True
            state.change_look(shows_skeleton=skeleton.value)

        def change_scene(name: str) -> Callable[[Any], None]:
            def change_it(value: Any) -> None:
                setattr(scene, name, value)
                state.change_look()

            return change_it

        inputs.on_user(surface, change_surface)
        inputs.on_user(self._skinned_resolution, change("skinned_resolution", int))
        inputs.on_user(self._field_resolution, change("field_resolution", int))
        inputs.on_user(pose_shape, change("has_pose_shape"))
        inputs.on_user(weights, change("weight_colors"))
        inputs.on_user(canonical, change("shows_canonical"))
        inputs.on_user(skeleton, change("shows_skeleton"))
        inputs.on_user(handle_box, change_handle)
        inputs.on_user(wireframe, change_scene("is_wireframe"))
        inputs.on_user(color, change_scene("body_color"))

    def _show_resolution(self, surface: str) -> None:
        self._skinned_resolution.visible = surface == "skinned"
        self._field_resolution.visible = surface == "field"
