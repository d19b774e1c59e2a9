"""The cache of compiled kernels: where it is, and what killed processes and damage leave of it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from snarfcli.native import kernel_cache
from snarfcli.native.kernel_cache import cache_folder, read_cached, write_cached

on_unix = pytest.mark.skipif(os.name != "posix", reason="folders and signals as on Unix")


@pytest.fixture
def no_home(monkeypatch):
    """A user without a home folder, as in some containers: neither HOME nor an entry among the system's users."""
    monkeypatch.delenv("HOME", raising=False)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)

    def fail() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(kernel_cache.Path, "home", fail)


@on_unix
def test_the_folder_is_the_user_s(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    assert cache_folder() == tmp_path / ".cache" / "snarf" / "cuda"
    monkeypatch.setenv("XDG_CACHE_HOME", "here")  # relative, which is invalid
    assert cache_folder() == tmp_path / ".cache" / "snarf" / "cuda"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "elsewhere"))
    assert cache_folder() == tmp_path / "elsewhere" / "snarf" / "cuda"


@on_unix
def test_without_a_home_the_named_folder_is_used_and_else_none(monkeypatch, no_home, tmp_path):
    assert cache_folder() is None
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "snarf" / "cuda"


def test_what_was_written_is_read(tmp_path):
    path = tmp_path / "snarf" / "cuda" / "kernel.bin"
    assert read_cached(path) is None
    write_cached(path, b"code")
    assert read_cached(path) == b"code"
    assert list(path.parent.iterdir()) == [path]
    content = path.read_bytes()
    for damage in (b"", content[:10], content[:-1], content[:-1] + b"?"):
        path.write_bytes(damage)
        assert read_cached(path) is None


@on_unix
def test_a_killed_writer_leaves_no_entry(tmp_path):
    path = tmp_path / "kernel.bin"
    code = (
        "import os, signal, sys; from pathlib import Path; from snarfcli.native import kernel_cache\n"
        "kernel_cache.os.replace = lambda *_: os.kill(os.getpid(), signal.SIGKILL)\n"
        "kernel_cache.write_cached(Path(sys.argv[1]), b'code')\n"
    )
    done = subprocess.run([sys.executable, "-c", code, str(path)])
    assert done.returncode == -signal.SIGKILL
    assert read_cached(path) is None
    (left,) = tmp_path.iterdir()

    write_cached(path, b"code")
    assert read_cached(path) == b"code"
    assert left.exists(), "the writer may still be at work"
    long_ago = left.stat().st_mtime - 2 * kernel_cache._ABANDONED_S
    os.utime(left, (long_ago, long_ago))
    write_cached(tmp_path / "other.bin", b"code")
    assert sorted(file.name for file in tmp_path.iterdir()) == ["kernel.bin", "other.bin"]


def test_a_folder_that_cannot_be_made_is_done_without(tmp_path):
    (tmp_path / "file").touch()
    write_cached(tmp_path / "file" / "kernel.bin", b"code")
    assert read_cached(tmp_path / "file" / "kernel.bin") is None


def test_an_interrupted_writer_removes_its_file(tmp_path, monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(kernel_cache.os, "replace", interrupt)
    with pytest.raises(KeyboardInterrupt):
        write_cached(tmp_path / "kernel.bin", b"code")
    assert not list(tmp_path.iterdir())
