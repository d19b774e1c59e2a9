"""The version of the code: which changes of its files it tells apart."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from snarfcli import versions


@pytest.fixture
def checkout(tmp_path) -> Path:
    """A package with configuration and native sources beside it."""
    folder = tmp_path / "checkout"
    for name in ("package/a.py", "package/b.py", "conf/a.yaml", "csrc/cpu/a.cpp"):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(name)
    return folder


def test_the_digest_is_that_of_names_and_contents_of_sources(checkout, tmp_path):
    digest = versions._digest(checkout / "package")
    (checkout / "package/notes.txt").touch()
    (checkout / "package/.#a.py").symlink_to("user@host.1")  # what an editor leaves while a file is changed
    (checkout / "package/folder.py").mkdir()
    assert versions._digest(checkout / "package") == digest
    shutil.copytree(checkout, tmp_path / "copy", symlinks=True)
    assert versions._digest(tmp_path / "copy/package") == digest
    seen = {digest}
    for name in ("package/a.py", "conf/a.yaml", "csrc/cpu/a.cpp"):
        (checkout / name).write_text("other")
        seen.add(versions._digest(checkout / "package"))
    (checkout / "package/b.py").rename(checkout / "package/c.py")
    seen.add(versions._digest(checkout / "package"))
    assert len(seen) == 5


def test_an_installed_package_has_its_configuration_inside(checkout):
    shutil.copytree(checkout / "conf", checkout / "package/conf")
    digest = versions._digest(checkout / "package")
    (checkout / "conf/a.yaml").write_text("of another program")
    assert versions._digest(checkout / "package") == digest
    (checkout / "package/conf/a.yaml").write_text("other")
    assert versions._digest(checkout / "package") != digest


def test_a_folder_that_is_no_checkout_has_no_commit(checkout):
    assert versions._commit(checkout) is None
    (checkout / ".git").mkdir()
    assert versions._commit(checkout) is None, "git cannot tell"
