"""What a browser draws of an exported file, by the shaders of three.js; skipped without Chromium and three.js."""

from __future__ import annotations

import json
import re
import subprocess
import threading
from dataclasses import replace
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
import torch
from chromium_page import CHROMIUM, needs_chromium
from glb_reader import READERS, SCRIPTS, needs_readers
from toy_character import FRAME_RATE, ToyCharacter, wave

from snarfcli.export.character import CharacterOptions
from snarfcli.export.clips import Clip
from snarfcli.export.export import export_character

FRAMES = (0, 5, 11)


@pytest.fixture
def served(tmp_path):
    """Serve `tmp_path`, the page and three.js on this machine; return the address."""

    class Handler(SimpleHTTPRequestHandler):
        def translate_path(self, path: str) -> str:
            name = path.split("?")[0].lstrip("/")
            root = READERS if name.startswith("node_modules/") else SCRIPTS if name == "page.html" else tmp_path
            return str(root / name)

        def log_message(self, *arguments: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def draw(address: str, clip: str, times: list[float], profile: Path) -> dict:
    query = f"file=worm.glb&clip={clip}&times={','.join(map(str, times))}"
    assert CHROMIUM is not None
    command = [
        CHROMIUM, "--headless=new", "--no-sandbox", f"--user-data-dir={profile}", "--no-first-run", "--disable-extensions",
        "--disable-background-networking", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
        "--virtual-time-budget=60000", "--dump-dom", f"{address}/page.html?{query}",
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    answer = re.search(r"FOUND (.*) END", done.stdout)
    assert answer, done.stdout + done.stderr
    return json.loads(answer[1])


@needs_readers
@needs_chromium
def test_the_silhouettes_are_those_of_the_skinned_surface(tmp_path, served):
    toy, motion = ToyCharacter(), wave()
    motion = replace(motion, translation=motion.translation - [0.5, 1, 0])  # into the middle of the picture
    export_character(toy, tmp_path / "worm.glb", [Clip(motion)], CharacterOptions(triangles=None, resolution=40))
    drawn = draw(served, "wave", [frame / FRAME_RATE for frame in FRAMES], tmp_path / "profile")
    for frame, picture in zip(FRAMES, drawn["found"], strict=True):
        pose, translation = (torch.from_numpy(part[frame]).float() for part in (motion.poses, motion.translation))
        vertices = toy.skinned_surface(40).posed(pose, translation).vertices
        bounds = np.stack([vertices.min(0), vertices.max(0)])[:, :2].T.ravel()  # left, right, low, high
        assert picture["pixels"] > 1000
        np.testing.assert_allclose(picture["bounds"], bounds, atol=1.01 * drawn["pixel"])
