"""The tab of the look: surface, resolution, colours and what is shown beside it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from snarfcli.viewer.inputs import on_user
from snarfcli.viewer.picture import RESOLUTIONS, SURFACE_NAMES
from snarfcli.viewer.scene import ViewerScene
from snarfcli.viewer.state import ViewerState

__all__ = ["LookTab"]


class LookTab:
    """The inputs of the look, added to the current container of viser.

    Args:
        gui: GUI of viser.
        state: state of the viewer.
        scene: scene of the viewer.
    """

    def __init__(self, gui: Any, state: ViewerState, scene: ViewerScene) -> None:
        look = state.look
        has_weights = state.body.has_weights
        surfaces = SURFACE_NAMES if has_weights else ("field",)
        surface = gui.add_dropdown(
            "Surface", surfaces, initial_value=look.surface, hint="skinned: at once; field: exact where the body meets itself"
        )
        self._skinned_resolution, self._field_resolution = (
            gui.add_dropdown("Resolution", tuple(map(str, sorted({*RESOLUTIONS, number}))), initial_value=str(number))
            for number in (look.skinned_resolution, look.field_resolution)
        )
        self._show_resolution(look.surface)
        pose_shape = gui.add_checkbox("Shape of the pose", look.has_pose_shape, hint="or that of the canonical pose")
        weights = gui.add_checkbox("Weights in colour", look.weight_colors)
        canonical = gui.add_checkbox("Canonical shape beside it", look.shows_canonical)
        skeleton = gui.add_checkbox("Skeleton", look.shows_skeleton, hint="click a joint to choose it")
        handle_box = gui.add_checkbox("Handle at the joint", False, hint="turn the chosen joint in the picture")
        wireframe = gui.add_checkbox("Wireframe", False)
        color = gui.add_rgb("Body", scene.body_color)
        camera = gui.add_button("Frame the body", icon="focus-2")
        for box in (pose_shape, weights, canonical):
            box.visible = has_weights

        def change(name: str, convert: Callable[[Any], Any] = lambda value: value) -> Callable[[Any, Any], None]:
            return lambda handle, client: state.change_look(**{name: convert(handle.value)})

        def change_surface(handle: Any, client: Any) -> None:
            self._show_resolution(handle.value)
            state.change_look(surface=handle.value)

        def change_handle(handle: Any, client: Any) -> None:
            scene.shows_handle = handle.value
            if handle.value and not skeleton.value:
                skeleton.value = True
            state.change_look(shows_skeleton=skeleton.value)

        def change_scene(name: str) -> Callable[[Any, Any], None]:
            def change_it(handle: Any, client: Any) -> None:
                setattr(scene, name, handle.value)
                state.change_look()

            return change_it

        on_user(surface, change_surface)
        on_user(self._skinned_resolution, change("skinned_resolution", int))
        on_user(self._field_resolution, change("field_resolution", int))
        on_user(pose_shape, change("has_pose_shape"))
        on_user(weights, change("weight_colors"))
        on_user(canonical, change("shows_canonical"))
        on_user(skeleton, change("shows_skeleton"))
        on_user(handle_box, change_handle)
        on_user(wireframe, change_scene("is_wireframe"))
        on_user(color, change_scene("body_color"))
        camera.on_click(lambda event: event.client and scene.frame_body(event.client.camera))

    def _show_resolution(self, surface: str) -> None:
        self._skinned_resolution.visible = surface == "skinned"
        self._field_resolution.visible = surface == "field"
