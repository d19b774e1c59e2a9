"""`snarf view`: show an avatar in the browser, pose it and play motions."""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import socket
import sys
import webbrowser
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from omegaconf import MISSING

from snarfcli.avatar import Avatar
from snarfcli.checks import check_choice, check_number
from snarfcli.commands.selection import (
    AvatarSelection,
    MotionSelection,
    check_motion_selection,
    load_selected_avatar,
    select_motion,
)
from snarfcli.errors import UserError
from snarfcli.meshing.posed import RESOLUTIONS
from snarfcli.motions import OUT_OF_DISTRIBUTION_SEQUENCES, TRAINING_SEQUENCES
from snarfcli.motions.layouts import SMPL, layout_of
from snarfcli.names import unique_names
from snarfcli.samples.store import SampleStore
from snarfcli.viewer.access import is_loopback
from snarfcli.viewer.picture import SURFACE_NAMES, ViewerLook
from snarfcli.viewer.server import ViewServer, can_open_browser, check_port, require_viser

__all__ = ["ViewConfig", "run", "start"]

log = logging.getLogger(__name__)

_EXIT_INTERRUPTED = 130


@dataclass
class ViewConfig(AvatarSelection, MotionSelection):
    """Settings of `snarf view`."""

    pose: list[str] = MISSING
    """Motion files (.npz of AMASS, .pkl of AIST++, .npy, .bvh, .glb, .vrma) or folders of frames; the first is played."""
    motion: str | None = MISSING
    """Built-in motion or sequence of the samples that is played first if there is no pose file; null for none."""
    surface: str = MISSING
    """Surface at the start: skinned (the moved canonical mesh, shown at once) or field (extracted in the background)."""
    resolution: int = MISSING
    """Voxels along the longest side at the start, 16 to 1024."""
    weight_colors: bool = MISSING
    """Colour vertices by their skinning weights at the start."""
    host: str = MISSING
    """Address to listen on: 127.0.0.1 for this machine only, 0.0.0.0 for all machines in the network (with a token)."""
    port: str = MISSING
    """Port to listen on; auto (or 0) for any free port."""
    open: bool = MISSING
    """Open the page in the browser if there is a display."""


def run(config: ViewConfig) -> int:
    """Serve the page until Ctrl-C.

    Returns:
        0 if the server ends by itself; Ctrl-C ends the process with exit code 130.

    Raises:
        UserError: viser is not installed, the avatar or a motion does not exist, or the port is in use.
    """
    try:
        server = start(config)
        server.wait()
    except KeyboardInterrupt:
        _leave()
    server.stop()
    return 0


def _leave() -> NoReturn:
    """End the process as after Ctrl-C, but at once: the exit of Python waits for threads, or aborts in their native code.

    Nothing is lost, since the viewer writes no files.
    """
    with contextlib.suppress(ValueError):  # not in the main thread
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # pressed twice
    print("snarf view: interrupted", file=sys.stderr)
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
    os._exit(_EXIT_INTERRUPTED)


def start(config: ViewConfig) -> ViewServer:
    """Start the server, print its address, open the browser if there is a display, and return.

    Raises:
        UserError: as `run`.
    """
    require_viser()
    port = _check(config)
    check_port(config.host, port)
    avatar, path = load_selected_avatar(config)
    if not avatar.has_skinning_weights and (config.weight_colors or config.surface == "skinned"):
        log.info("model %s has no skinning weights: only its field is shown", avatar.config.model.name)
    shelf = _Shelf(config, avatar)
    look = ViewerLook(
        surface=config.surface,
        skinned_resolution=config.resolution,
        field_resolution=config.resolution,
        weight_colors=config.weight_colors,
    )
    server = ViewServer(
        avatar,
        look,
        host=config.host,
        port=port,
        motions=shelf.names,
        load_motion=shelf.load,
        facts=_facts(config, avatar, path),
        first_motion=shelf.first,
    )
    _announce(config, avatar, path, server)
    return server


def _check(config: ViewConfig) -> int:
    """Check all settings before any work starts; return the port, 0 for any free one."""
    check_motion_selection(config)
    check_choice("surface", config.surface, SURFACE_NAMES)
    check_number("resolution", config.resolution, *RESOLUTIONS)
    text = config.port.strip()
    if text == "auto":
        return 0
    if not (text.isascii() and text.isdecimal() and int(text) < 65536):
        raise UserError(f"port: wanted a number from 1 to 65535, or auto for any free port, got '{config.port}'")
    return int(text)


class _Shelf:
    """The motions that the page offers. Pose files and the first motion are read at the start.

    Raises:
        UserError: a pose file or the first motion cannot be used.
    """

    def __init__(self, config: ViewConfig, avatar: Avatar) -> None:
        self._config = config
        self._skeleton = avatar.skeleton
        self._loaded: dict[str, tuple[Any, Any]] = {}
        for name, path in zip(_file_names(config.pose), config.pose, strict=True):
            chosen = select_motion(config, config, self._skeleton, path, None)
            self._loaded[name] = chosen.motion, chosen.bone_transforms
        self.names: list[str] = [*self._loaded, *_own_motions(config, avatar)]
        first = next(iter(self._loaded), config.motion)
        self.first: tuple[str, Any, Any] | None = None if first is None else (first, *self.load(first))
        """Name, motion and bone transforms of the first motion; None if no motion is played."""
        if first is not None and first not in self.names:
            self.names.insert(0, first)

    def load(self, name: str) -> tuple[Any, Any]:
        """Return a motion by its name, and its bone transforms if joints stretch; raises UserError."""
        if name not in self._loaded:
            chosen = select_motion(self._config, self._config, self._skeleton, None, name)
            self._loaded[name] = chosen.motion, chosen.bone_transforms
        return self._loaded[name]


def _file_names(paths: list[str]) -> list[str]:
    """Return a unique name for each file: its file name, or its path where file names are equal."""
    short = [Path(path).name for path in paths]
    return unique_names([
        f"file: {name if name and short.count(name) == 1 else path}" for name, path in zip(short, paths, strict=True)
    ])  # fmt: skip


def _own_motions(config: ViewConfig, avatar: Avatar) -> list[str]:
    """Return the motions that need no file: the built-in ones (SMPL), or the sequences of the samples (other skeletons)."""
    if layout_of(avatar.skeleton) == SMPL:
        return [*TRAINING_SEQUENCES, *OUT_OF_DISTRIBUTION_SEQUENCES]
    if config.data.name == "builtin":
        return []
    try:
        store = SampleStore.open(config.data_root, config.data.name, config.subject)
    except UserError:
        return []  # without samples the avatar can still be posed
    if (store.skeleton.names, store.skeleton.parents) != (avatar.skeleton.names, avatar.skeleton.parents):
        return []
    return [sequence.name for sequence in store.all_sequences]


def _facts(config: ViewConfig, avatar: Avatar, path: Path) -> dict[str, str]:
    """Return the facts about the avatar that the page shows."""
    settings = avatar.config
    facts = {
        "subject": str(avatar.facts.get("subject", config.subject)),
        "data": str(avatar.facts.get("data", config.data.name)),
        "model": settings.model.name,
        "condition": settings.condition.name,
        "joints": str(avatar.skeleton.num_joints),
        "device": str(avatar.device),
        "file": path.name if config.ckpt else f"{path.parent.name}/{path.name}",
    }
    if "steps" in avatar.facts:
        facts["training steps"] = f"{avatar.facts['steps']}"
    return facts


def _announce(config: ViewConfig, avatar: Avatar, path: Path, server: ViewServer) -> None:
    """Print the address of the page, and open it if the browser runs on this machine's display."""
    port = server.port
    log.info("avatar: %s, on %s", path, avatar.device)
    log.info("page: %s (Ctrl-C ends the server)", server.address)
    if not is_loopback(config.host):
        message = (
            "host=%s: whoever knows this address, with its token, can see and change the page; elsewhere it begins with %s"
        )
        log.warning(message, config.host, f"http://{socket.gethostname()}:{port}")
    if config.open and can_open_browser():
        webbrowser.open(server.address)
    elif is_loopback(config.host) and (os.environ.get("SSH_CONNECTION") or not can_open_browser()):
        log.info("from another machine: ssh -L %d:127.0.0.1:%d %s, then open the page there", port, port, socket.gethostname())
