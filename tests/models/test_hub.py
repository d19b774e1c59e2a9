"""Repositories of a hub in place of folders, with a client that stands for the real one."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType

import pytest
from tiny_avatars import tiny_avatar

from snarfcli.avatar import Avatar
from snarfcli.errors import UserError
from snarfcli.extras import MissingPackage
from snarfcli.models import hub


class Client(ModuleType):
    """A client that finds one repository in a folder, and keeps what it was asked for."""

    def __init__(self, folder: Path) -> None:
        super().__init__("huggingface_hub")
        self.folder = folder
        self.asked: list[tuple[str, str | None, list[str]]] = []

    def snapshot_download(self, repo_id: str, *, revision: str | None, allow_patterns: list[str]) -> str:
        self.asked.append((repo_id, revision, allow_patterns))
        if repo_id != "me/my-avatar":
            raise OSError(f"404 Client Error\n\nRepository Not Found for url: {repo_id}")
        return str(self.folder)


@pytest.fixture
def client(tmp_path, monkeypatch) -> Client:
    tiny_avatar().save_pretrained(tmp_path / "cache")
    client = Client(tmp_path / "cache")
    monkeypatch.setitem(sys.modules, "huggingface_hub", client)
    monkeypatch.setattr(hub, "require_packages", lambda extra: None)
    monkeypatch.chdir(tmp_path)
    return client


def test_a_repository_is_downloaded(client):
    for name in ("me/my-avatar", "hf://me/my-avatar"):
        assert Avatar.from_pretrained(name, revision="v1").facts["subject"] == "tiny"
    assert client.asked == [("me/my-avatar", "v1", ["config.json", "model.safetensors", "README.md"])] * 2


@pytest.mark.parametrize(
    "name", ["cache", "./cache", "cache/none", "none", "none/", "/none/there", "a/b/c", "../none/x", Path("a/b"), "a b/c"]
)
def test_folders_do_not_reach_the_hub(client, name):
    if name in ("cache", "./cache"):
        assert Avatar.from_pretrained(name).facts["subject"] == "tiny"
    else:
        with pytest.raises(UserError, match="no "):
            Avatar.from_pretrained(name)
    assert client.asked == []


def test_what_cannot_be_downloaded_is_one_line(client):
    with pytest.raises(UserError) as caught:
        Avatar.from_pretrained("me/other")
    assert str(caught.value) == "me/other could not be downloaded (404 Client Error); check the name and the network"
    with pytest.raises(UserError, match="hf://me: wanted hf://owner/name"):
        Avatar.from_pretrained("hf://me")
    with pytest.raises(UserError, match="revision: wanted with a repository of a hub only, got it with cache"):
        Avatar.from_pretrained("cache", revision="main")


def test_without_the_client_it_says_what_to_install(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("snarfcli.extras.find_spec", lambda name: None)
    with pytest.raises(MissingPackage, match=r"\(huggingface-hub\); install them with: pip install 'snarf\[hub\]'"):
        Avatar.from_pretrained("me/my-avatar")
