"""A surface in the scene of viser, with one colour or a colour per vertex, updated without flicker."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from snarfcli.meshing.colors import weights_to_colors
from snarfcli.viewer.colored import colored_glb

__all__ = ["ShownSurface"]

# The browser takes a moment to load a .glb and shows nothing meanwhile. So the next one is loaded hidden, and replaces the
# current one after this time.
_LOADING_S = 0.1


class ShownSurface:
    """One surface on the page.

    Args:
        server: server of viser.
        name: path of its nodes in the scene.
    """

    def __init__(self, server: Any, name: str) -> None:
        self._server = server
        self._scene = server.scene
        self._name = name
        self._frame = self._scene.add_frame(name, show_axes=False)
        self._plain: Any = None
        self._faces: Any = None
        self._colored: list[Any] = [None, None]
        self._seen = 0  # which of the two is visible
        self._loading_since: float | None = None
        self._latest: tuple | None = None  # mesh to load next
        self._loading: Any = None
        self._wanted: tuple | None = None
        self._arrays: tuple = ()
        self.seen: Any = None
        """The `goes_with` of the visible mesh."""

    def place(self, position: tuple[float, float, float]) -> None:
        """Set the position of its origin."""
        self._frame.position = position

    def hide(self) -> None:
        """Hide the surface."""
        self._frame.visible, self.seen = False, None

    def show(
        self,
        vertices: NDArray[np.float32],
        faces: NDArray[np.int32],
        weights: NDArray[np.float32] | None,
        color: tuple[int, int, int],
        opacity: float,
        is_wireframe: bool,
        goes_with: Any = None,
    ) -> None:
        """Show a mesh in one colour, or coloured by its weights [V, J], which takes a moment.

        Args:
            vertices: [V, 3], metres.
            faces: [F, 3].
            weights: [V, J]; None for one colour.
            color: sRGB.
            opacity: 0 to 1.
            is_wireframe: whether edges are drawn, in one colour.
            goes_with: value of `seen` once this mesh is visible.
        """
        self._frame.visible = True
        wanted = (id(vertices), id(faces), id(weights), color, opacity, is_wireframe)
        if wanted == self._wanted and goes_with is None:
            return
        self._wanted, self._arrays = wanted, (vertices, faces, weights)  # kept, so that no new array gets their ids
        if weights is not None and not is_wireframe:  # a .glb cannot be drawn as a wireframe
            self._latest = (vertices, faces, weights, opacity, goes_with)
            return
        self.seen = goes_with
        self._latest, self._loading_since = None, None
        self._show_colored(None)
        if self._plain is None:
            self._plain = self._scene.add_mesh_simple(
                f"{self._name}/plain", vertices, faces, color=color, opacity=_opacity(opacity), wireframe=is_wireframe
            )
        else:
            with self._server.atomic():
                if faces is not self._faces:
                    self._plain.faces = faces.astype(np.uint32)
                self._plain.vertices = vertices
            self._plain.color, self._plain.opacity, self._plain.wireframe = color, _opacity(opacity), is_wireframe
        self._faces = faces
        self._plain.visible = True

    def advance(self, now: float) -> float | None:
        """Load and swap coloured meshes; return the time of the next call, None if there is nothing to do."""
        if self._loading_since is not None:
            if now < self._loading_since + _LOADING_S:
                return self._loading_since + _LOADING_S
            self._loading_since = None
            self.seen = self._loading
            self._show_colored(1 - self._seen)
            if self._plain is not None:
                self._plain.visible = False
        if self._latest is None:
            return None
        vertices, faces, weights, opacity, self._loading = self._latest
        self._latest = None
        unseen = 1 - self._seen
        data = colored_glb(vertices, faces, weights_to_colors(weights), opacity)
        if self._colored[unseen] is None:
            self._colored[unseen] = self._scene.add_glb(f"{self._name}/colored_{unseen}", data, visible=False)
        else:
            self._colored[unseen].glb_data = data
        self._loading_since = now
        return now + _LOADING_S

    def _show_colored(self, number: int | None) -> None:
        with self._server.atomic():
            for index, node in enumerate(self._colored):
                if node is not None:
                    node.visible = index == number
        if number is not None:
            self._seen = number


def _opacity(opacity: float) -> float | None:
    return None if opacity >= 1 else opacity
