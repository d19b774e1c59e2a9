"""`snarf view` from its settings to the page that it serves, on two capsules end to end."""

from __future__ import annotations

import logging
import os
import signal
import socket
import subprocess
import sys
import urllib.request
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from toy_avatar import ToyAvatar

from snarfcli.avatar import Avatar
from snarfcli.cli.main import main
from snarfcli.commands import view
from snarfcli.commands.view import ViewConfig, run, start
from snarfcli.datasets.settings import DataConfig
from snarfcli.errors import UserError
from snarfcli.viewer.server import ViewServer, check_port

pytest.importorskip("viser", reason="the viewer needs viser: pip install 'snarf[view]'")


@pytest.fixture
def toy(monkeypatch) -> ToyAvatar:
    avatar = ToyAvatar()
    avatar.config = SimpleNamespace(model=SimpleNamespace(name="capsules"), condition=SimpleNamespace(name="none"))
    avatar.facts = {"subject": "50002", "data": "builtin", "steps": 7}
    monkeypatch.setattr(Avatar, "load", classmethod(lambda cls, path, device: avatar))
    return avatar


@pytest.fixture(autouse=True)
def opened(monkeypatch) -> list[str]:
    """Addresses that a browser was opened with, on a machine with a display."""
    addresses: list[str] = []
    monkeypatch.setattr(view.webbrowser, "open", addresses.append)
    monkeypatch.setattr(view, "can_open_browser", lambda: True)
    return addresses


@pytest.fixture
def config(tmp_path: Path, toy: ToyAvatar, monkeypatch) -> ViewConfig:
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "outputs" / "builtin" / "50002" / "fast_snarf"
    folder.mkdir(parents=True)
    (folder / "avatar.pt").write_bytes(b"the toy")
    return ViewConfig(
        subject="50002",
        data=DataConfig("builtin", 8, 1, 1),
        data_root="data",
        output_root="outputs",
        run="fast_snarf",
        ckpt=None,
        device="cpu",
        threads=None,
        up="y",
        hands="rest",
        rest="auto",
        mapping=None,
        clip=None,
        motion_seed=0,
        motion_frame_rate=30.0,
        start=0,
        stop=None,
        step=1,
        frame_rate=None,
        max_frames=None,
        in_place=False,
        pose=[],
        motion=None,
        surface="skinned",
        resolution=24,
        weight_colors=False,
        host="127.0.0.1",
        port="auto",
        open=True,
    )


@pytest.fixture
def served(config):
    """Starts a viewer with changed settings, and stops it in the end."""
    servers: list[ViewServer] = []

    def serve(**changes) -> ViewServer:
        servers.append(start(replace(config, **changes)))
        return servers[-1]

    yield serve
    for server in servers:
        server.stop()


def pose_file(name: str, frames: int = 3) -> str:
    poses = np.zeros((frames, 6))
    poses[:, 5] = np.linspace(0, 0.9, frames)
    Path(name).parent.mkdir(exist_ok=True)
    np.savez(name, poses=poses, trans=np.zeros((frames, 3)), mocap_framerate=24.0)
    return name


def test_the_page_is_served_and_opened(served, opened, caplog):
    with caplog.at_level(logging.INFO):
        server = served()
    address = f"http://127.0.0.1:{server.port}"
    assert opened == [address]
    assert f"page: {address} (Ctrl-C ends the server)" in caplog.text
    assert "ssh -L" not in caplog.text
    assert "anybody" not in caplog.text
    with urllib.request.urlopen(address, timeout=300) as answer:
        assert answer.status == 200
    assert server.state.motion is None
    assert server.state.look.skinned_resolution == 24


def test_without_a_display_the_way_from_elsewhere_is_told(served, opened, monkeypatch, caplog):
    monkeypatch.setattr(view, "can_open_browser", lambda: False)
    with caplog.at_level(logging.INFO):
        server = served()
    assert not opened
    assert f"ssh -L {server.port}:127.0.0.1:{server.port} " in caplog.text


def test_no_browser_if_not_wanted(served, opened):
    served(open=False)
    assert not opened


def test_who_listens_to_all_is_warned(served, opened, caplog):
    with caplog.at_level(logging.WARNING):
        server = served(host="0.0.0.0")
    (record,) = caplog.records
    assert record.message.startswith("host=0.0.0.0: whoever knows this address, with its token, can see and change the page")
    assert record.message.endswith(f"http://{socket.gethostname()}:{server.port}")
    assert server.access.token
    assert server.access.token not in caplog.text
    assert opened == [f"http://127.0.0.1:{server.port}/?token={server.access.token}"]


def test_pose_files_are_on_the_shelf_and_the_first_one_plays(served):
    files = [pose_file("wave.npz"), pose_file("bend.npz", 5), pose_file("other/wave.npz", 4)]
    server = served(pose=files)
    assert server.state.player.is_playing
    assert server.state.motion.num_frames == 3
    assert server.controls.motion.names.options == ("none", "file: wave.npz", "file: bend.npz", "file: other/wave.npz")
    assert server.controls.motion.names.value == "file: wave.npz"
    server.controls.motion.choose("file: other/wave.npz")
    assert server.state.motion.num_frames == 4


def test_no_pose_file_hides_another_one(served):
    files = [pose_file("other/wave.npz", 4), pose_file("wave.npz"), "wave.npz"]
    server = served(pose=files)
    names = ("file: other/wave.npz", "file: wave.npz", "file: wave.npz_2")
    assert server.controls.motion.names.options == ("none", *names)
    assert server.state.motion.num_frames == 4
    server.controls.motion.choose(names[1])
    assert server.state.motion.num_frames == 3


def test_sequences_of_the_samples_are_on_the_shelf(served, config, toy, monkeypatch):
    skeleton = SimpleNamespace(names=toy.skeleton.names, parents=toy.skeleton.parents)
    store = SimpleNamespace(skeleton=skeleton, all_sequences=[SimpleNamespace(name="trot"), SimpleNamespace(name="sit")])
    monkeypatch.setattr(view.SampleStore, "open", staticmethod(lambda *arguments: store))
    server = served(data=DataConfig("meshes", 1, 1, 1), ckpt="outputs/builtin/50002/fast_snarf")
    assert server.controls.motion.names.options == ("none", "trot", "sit")
    store.skeleton = SimpleNamespace(names=("a", "b"), parents=(-1, 0))
    server = served(data=DataConfig("meshes", 1, 1, 1), ckpt="outputs/builtin/50002/fast_snarf")
    assert server.controls.motion.names.options == ("none",)


def test_ctrl_c_leaves_at_once(config, monkeypatch, capsys):
    servers: list[ViewServer] = []

    def interrupted(server: ViewServer) -> None:
        servers.append(server)
        raise KeyboardInterrupt

    def leave(code: int) -> None:
        raise SystemExit(code)

    before = signal.getsignal(signal.SIGINT)
    monkeypatch.setattr(ViewServer, "wait", interrupted)
    monkeypatch.setattr(view.os, "_exit", leave)
    try:
        with pytest.raises(SystemExit) as left:
            main(["view", "--port", "auto", "--no-open", "--pose", pose_file("wave.npz"), "up=y", "resolution=24"])
    finally:
        signal.signal(signal.SIGINT, before)
        servers[0].stop()
    assert left.value.code == 130
    assert "snarf view: interrupted" in capsys.readouterr().err


def test_a_server_that_ends_by_itself_leaves_its_port(config, monkeypatch):
    ports: list[int] = []
    monkeypatch.setattr(ViewServer, "wait", lambda server: ports.append(server.port))
    assert run(config) == 0
    check_port("127.0.0.1", ports[0])


ENDLESS = """
import signal
import sys
from types import SimpleNamespace

import torch
from toy_avatar import ToyAvatar

from snarfcli.avatar import Avatar
from snarfcli.cli.main import main


class Endless(ToyAvatar):
    def canonical_logits(self, points_c, pose):
        print("computing", flush=True)
        while True:
            torch.ones(10**6).sum()  # native code


avatar = Endless()
avatar.config = SimpleNamespace(model=SimpleNamespace(name="capsules"), condition=SimpleNamespace(name="none"))
Avatar.load = classmethod(lambda cls, path, device: avatar)
signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored where the tests run in the background
sys.exit(main(["view", "--no-open", "ckpt=toy.pt", "data=meshes", "subject=a"]))
"""


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGINT for one process")
def test_ctrl_c_ends_the_process_while_a_surface_is_computed(tmp_path):
    (tmp_path / "toy.pt").write_bytes(b"the toy")
    child = subprocess.Popen(
        [sys.executable, "-c", ENDLESS], cwd=tmp_path, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
    )  # fmt: skip
    lines: list[str] = []
    try:
        while not any("Ctrl-C" in line for line in lines) or not any("computing" in line for line in lines):
            lines.append(child.stdout.readline())
            assert lines[-1], child.stderr.read()
        child.send_signal(signal.SIGINT)
        _, errors = child.communicate(timeout=300)
    finally:
        child.kill()
    assert (child.returncode, errors) == (130, "snarf view: interrupted\n")


def test_without_viser_one_line_before_any_work(config, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "viser", None)
    assert main(["view", "ckpt=nowhere.pt"]) == 2
    err = capsys.readouterr().err
    assert "pip install 'snarf[view]'" in err
    assert err.count("\n") == 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"port": "http"}, "port: wanted a number from 1 to 65535, or auto for any free port, got 'http'"),
        ({"port": "65536"}, "port: wanted a number"),
        ({"port": "-1"}, "port: wanted a number"),
        ({"host": "203.0.113.7"}, "host: wanted an address of this machine, got 203.0.113.7"),
        ({"surface": "feild"}, "surface: wanted skinned or field, got 'feild'; did you mean 'field'"),
        ({"resolution": 15}, "resolution: wanted 16 to 1024, got 15"),
        ({"step": 0}, "step: wanted at least 1"),
        ({"pose": ["nowhere.npz"]}, "no pose file at nowhere.npz"),
        ({"motion": "jumping_jacks"}, "got jumping_jacks, which is for SMPL's 24"),
        ({"subject": "50004"}, 'no avatar in .*50004.*; run "snarf train subject=50004" or give ckpt=PATH'),
    ],
    ids=lambda value: ",".join(value) if isinstance(value, dict) else "",
)
def test_what_a_user_can_get_wrong(config, change, message):
    with pytest.raises(UserError, match=message):
        start(replace(config, **change))
