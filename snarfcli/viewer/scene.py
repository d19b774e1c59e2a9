"""The 3D scene of the page: avatar, canonical shape, skeleton, floor and camera."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from snarfcli.viewer.body import Posed
from snarfcli.viewer.gate import Gate
from snarfcli.viewer.joints import global_turns, posed_joints, vector_from_turn
from snarfcli.viewer.picture import Picture
from snarfcli.viewer.state import ViewerState
from snarfcli.viewer.surfaces import ShownSurface

__all__ = ["BODY_COLOR", "ViewerScene"]

BODY_COLOR = (205, 184, 168)
"""Colour of the body, sRGB: clay, on which shading is well visible."""

_JOINTS_NODE, _HANDLE_NODE = "/skeleton/joints", "/handle"
_BONE, _JOINT, _CHOSEN = (70, 80, 95), (255, 214, 102), (235, 94, 40)  # sRGB
_SEE_THROUGH = 0.45  # opacity of a body with a visible skeleton
_FIELD_OF_VIEW_RAD = 0.6
_ROOM, _ROOM_ASIDE = 0.74, 0.46  # half the height of the picture over the size of one body, and over the width of two
_PANEL = 0.3  # shift of the middle for the panel, which covers the right side


@dataclass(frozen=True, eq=False)
class _SkeletonNodes:
    """Nodes of viser for the skeleton."""

    joints: Any
    bones: Any
    """None for a single joint."""
    handle: Any


class ViewerScene:
    """The scene, shared by all clients.

    Args:
        server: server of viser.
        gate: told what clients can click and drag.
        state: state of the viewer.
        choose_joint: called with the number of a joint that a user clicked.
        clock: returns the time, seconds.
    """

    def __init__(
        self,
        server: Any,
        gate: Gate,
        state: ViewerState,
        choose_joint: Callable[[int], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._server = server
        self._gate = gate
        self._state = state
        self._skeleton = state.body.skeleton
        self._choose_joint = choose_joint
        self._clock = clock
        self.body_color = BODY_COLOR
        self.is_wireframe = False
        self.shows_handle = False
        self.chosen_joint = 0
        self._shown: tuple | None = None
        self._picture: Picture | None = None
        self._turning: set[int | None] = set()  # numbers of the clients that drag the handle
        rest = state.body.transforms(np.zeros((self._skeleton.num_joints, 3)), np.zeros(3))
        joints = posed_joints(self._skeleton, rest)
        self.size = float(max(np.ptp(joints, axis=0).max(), 0.1))
        self._aside = float(1.15 * max(np.ptp(joints[:, 0]), 0.6 * self.size))
        server.scene.set_up_direction("+y")
        server.scene.configure_environment_map("studio", environment_intensity=0.2)
        self._floor = server.scene.add_grid(
            "/floor", plane="xz", infinite_grid=True, cell_size=self._square() / 4, section_size=self._square(),
            cell_color=(222, 226, 230), section_color=(176, 183, 191), fade_distance=8 * self.size, fade_from="origin",
            shadow_opacity=0.25,
        )  # fmt: skip
        self._body = ShownSurface(server, "/avatar")
        self._canonical = ShownSurface(server, "/canonical")
        self._label = server.scene.add_label("/canonical_label", "canonical shape", visible=False)
        self._skeleton_nodes: _SkeletonNodes | None = None  # created when the skeleton is shown first
        camera = server.initial_camera
        camera.up, camera.fov = np.array([0.0, 1.0, 0.0]), _FIELD_OF_VIEW_RAD
        camera.position, camera.look_at = self._camera(False)

    def frame_body(self, camera: Any) -> None:
        """Place a camera so that it sees the body, and the canonical shape beside it if it is shown."""
        position, look_at = self._camera(self._state.look.shows_canonical)
        camera.up_direction, camera.position, camera.look_at = (0.0, 1.0, 0.0), position, look_at

    def show(self, picture: Picture) -> None:
        """Update the scene."""
        with self._server.atomic():
            self._floor.position = (0.0, picture.floor_y, 0.0)
            mesh, mesh_c = picture.mesh, picture.canonical
            main = () if mesh is None else (mesh.posed.number, mesh.surface, mesh.seconds, id(mesh.faces))
            beside = () if mesh_c is None else (id(mesh_c.vertices), id(mesh_c.faces), picture.floor_y)
            key = (main, beside, picture.look, self.body_color, self.is_wireframe)
            if key != self._shown:
                self._shown, self._picture = key, picture  # kept, so that no new array gets the id of its arrays
                self._show_surfaces(picture)
            self.advance()
            self._show_skeleton(self._body.seen or picture.shown, picture.look.shows_skeleton)

    def advance(self) -> float | None:
        """Continue delayed updates; return the seconds until the next one, None if there is none."""
        now = self._clock()
        times = [due for due in (self._body.advance(now), self._canonical.advance(now)) if due is not None]
        return max(min(times) - now, 0.0) if times else None

    # ---------------------------------------------------------------- parts
    def _show_surfaces(self, picture: Picture) -> None:
        look = picture.look
        opacity = _SEE_THROUGH if look.shows_skeleton else 1.0
        mesh = picture.mesh
        if mesh is None:
            self._body.hide()
        else:
            self._body.show(
                mesh.vertices, mesh.faces, mesh.weights, self.body_color, opacity, self.is_wireframe, goes_with=mesh.posed
            )
        mesh_c = picture.canonical
        if mesh_c is None:
            self._canonical.hide()
        else:
            weights = mesh_c.weights if look.weight_colors else None
            self._canonical.show(mesh_c.vertices, mesh_c.faces, weights, self.body_color, 1.0, self.is_wireframe)
            low = float(mesh_c.vertices[:, 1].min())
            self._canonical.place((-self._aside, picture.floor_y - low, 0.0))
            top = picture.floor_y + float(np.ptp(mesh_c.vertices[:, 1])) + 0.06 * self.size
            self._label.position = (-self._aside, top, 0.0)
        self._label.visible = mesh_c is not None

    def _show_skeleton(self, shown: Posed, shows: bool) -> None:
        if not shows and self._skeleton_nodes is None:
            return
        joints = posed_joints(self._skeleton, shown.transforms)
        if self._skeleton_nodes is None:
            self._skeleton_nodes = self._add_skeleton(joints)
        nodes = self._skeleton_nodes
        nodes.joints.visible = shows
        if nodes.bones is not None:
            nodes.bones.visible = shows
        nodes.handle.visible = shows and self.shows_handle
        if not shows:
            return
        nodes.joints.batched_positions = joints
        colors = np.full((len(joints), 3), _JOINT, dtype=np.uint8)
        colors[self.chosen_joint] = _CHOSEN
        nodes.joints.batched_colors = colors
        if nodes.bones is not None:
            nodes.bones.points = joints[np.array(self._skeleton.bones)]
        if not self._turning:
            nodes.handle.position = joints[self.chosen_joint]
            turn = global_turns(self._skeleton, shown.transforms)[self.chosen_joint]
            nodes.handle.wxyz = turn.as_quat()[[3, 0, 1, 2]]

    def _add_skeleton(self, joints: np.ndarray) -> _SkeletonNodes:
        import trimesh

        ball = trimesh.creation.icosphere(subdivisions=2, radius=0.015 * self.size)
        turns = np.tile([1.0, 0.0, 0.0, 0.0], (len(joints), 1))
        balls = self._server.scene.add_batched_meshes_simple(
            _JOINTS_NODE, ball.vertices, ball.faces, turns, joints, lod="off", cast_shadow=False,
            batched_colors=np.full((len(joints), 3), _JOINT, dtype=np.uint8), receive_shadow=False,
        )  # fmt: skip
        balls.on_click(self._gate.reaction(lambda event: self._choose_joint(event.instance_index)))
        self._gate.add_clickable(_JOINTS_NODE, len(joints))
        bones = None
        if self._skeleton.bones:
            ends = joints[np.array(self._skeleton.bones)]
            bones = self._server.scene.add_line_segments("/skeleton/bones", ends, _BONE, thickness=0.007 * self.size)
        handle = self._server.scene.add_transform_controls(
            _HANDLE_NODE, scale=0.13 * self.size, disable_axes=True, disable_sliders=True, depth_test=False, visible=False
        )
        self._gate.add_handle(_HANDLE_NODE)
        handle.on_update(
            self._gate.reaction(lambda event: self.turn_chosen(event.target.wxyz, event.phase == "end", event.client_id))
        )
        return _SkeletonNodes(balls, bones, handle)

    def turn_chosen(self, wxyz: np.ndarray, is_over: bool, client_id: int | None) -> None:
        """Rotate the chosen joint as a client rotated the handle, a quaternion; the handle is not moved until this is over."""
        (self._turning.discard if is_over else self._turning.add)(client_id)
        turn = Rotation.from_quat(np.asarray(wxyz)[[1, 2, 3, 0]])
        vector = vector_from_turn(self._skeleton, self._state.pause().transforms, self.chosen_joint, turn)
        self._state.turn_joint(self.chosen_joint, vector)

    def let_go(self, client_id: int) -> None:
        """Release the handle of a client that has left, maybe while dragging it."""
        self._turning.discard(client_id)

    def _square(self) -> float:
        """Return the width of a square of the floor, metres: 1 for the size of a person, else a power of ten."""
        return float(10.0 ** np.round(np.log10(self.size / 1.3)))

    def _camera(self, shows_canonical: bool) -> tuple[np.ndarray, np.ndarray]:
        """Return position and target of a camera, metres: in front of the body, slightly to its left."""
        joints = posed_joints(self._skeleton, self._state.posed.transforms)
        floor_y, half = self._state.floor_y, self.size / 2
        middle = np.array([joints[:, 0].mean(), floor_y + 1.12 * half, joints[:, 2].mean()])
        low, high = middle - half, middle + half
        if shows_canonical:
            low[0] -= self._aside
        # half the height of the picture at the body, metres; the picture is wider than high
        reach = max(_ROOM * self.size, _ROOM_ASIDE * (high[0] - low[0]))
        distance = reach / np.tan(_FIELD_OF_VIEW_RAD / 2) + np.ptp(joints[:, 2]) / 2
        look_at = (low + high) / 2 + (_PANEL * reach, 0.0, 0.0)
        ahead = np.array([0.42, 0.22, 1.0])
        return look_at + distance * ahead / np.linalg.norm(ahead), look_at
