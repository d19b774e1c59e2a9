"""The page of an avatar: what is in it, and that texts from files are only texts."""

from __future__ import annotations

import base64
import gzip
import hashlib
import json
import logging
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from glb_reader import GlbReader
from toy_character import FRAME_RATE, ToyCharacter, wave

from snarfcli.avatar import Avatar
from snarfcli.errors import UserError
from snarfcli.export import html as html_export
from snarfcli.export.character import CharacterOptions
from snarfcli.export.clips import Clip
from snarfcli.export.html import HtmlConfig, export_html
from snarfcli.export.html_page import PageTexts, page_of, room_in_page
from snarfcli.texts import one_line

OPTIONS = CharacterOptions(triangles=600, resolution=40)
PAGE = Path(html_export.__file__).parent / "page"
HOSTILE = "</script></title><script>window.hacked = 1</script><img src=x onerror='window.hacked = 1'>\"&{{three}}\u2028\x1b[2J"


class Reader(HTMLParser):
    """Collects the elements of a page, their attributes and texts."""

    def __init__(self, page: bytes) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.texts: dict[str, str] = {}
        self._open = ""
        self.feed(page.decode())
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        self._open = dict(attrs).get("id") or (f"{tag}{len(self.elements)}" if tag == "script" else tag)

    def handle_endtag(self, tag: str) -> None:
        self._open = ""

    def handle_data(self, data: str) -> None:
        self.texts[self._open] = self.texts.get(self._open, "") + data

    def scripts(self) -> list[str]:
        """Return the texts of the scripts that run."""
        return [text for name, text in self.texts.items() if re.fullmatch(r"script\d+", name)]

    def character(self) -> bytes:
        """Return the `.glb` file in the page."""
        return gzip.decompress(base64.b64decode(self.texts["avatar"], validate=True))


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    toy = ToyCharacter()
    toy.facts = {"subject": HOSTILE, "data": "builtin"}
    path = tmp_path_factory.mktemp("html") / "worm.html"
    names = [f"{HOSTILE}{number}" for number in range(toy.skeleton.num_joints)]
    clips = [Clip(wave()), Clip(wave(3, HOSTILE))]
    report, notes = export_html(toy, path, clips, OPTIONS, joint_names=names)
    return path, report, notes, names


def test_the_page_holds_the_character(exported, tmp_path):
    path, report, notes, _ = exported
    page = path.read_bytes()
    assert report.num_bytes == len(page) < 1_500_000
    assert notes == []
    (tmp_path / "a.glb").write_bytes(Reader(page).character())
    reader = GlbReader(tmp_path / "a.glb")
    Avatar.export_glb(ToyCharacter(), tmp_path / "b.glb", wave(), triangles=600, resolution=40)
    found, wanted = (one.vertices("wave", 5 / FRAME_RATE) for one in (reader, GlbReader(tmp_path / "b.glb")))
    # Another clip beside it changes the morph targets a little.
    assert np.linalg.norm(found - wanted, axis=1).max() < 2e-3
    assert reader.primitive.attributes.COLOR_0 is not None


def test_texts_from_files_are_texts(exported):
    path, _, _, names = exported
    page = Reader(path.read_bytes())
    said = " ".join(HOSTILE.replace("\x1b", " ").replace("\u2028", " ").split())
    assert page.texts["title"] == page.texts["h1"] == said
    assert len(page.scripts()) == 2
    assert not [attributes for _, attributes in page.elements if "src" in attributes or "onerror" in attributes]
    facts = json.loads(page.texts["facts"])
    assert [bone["name"] for bone in facts["bones"]] == [one_line(name, 80) for name in names]
    assert facts["clips"] == ["wave", one_line(HOSTILE, 80)]
    assert all(re.fullmatch("#[0-9a-f]{6}", bone["color"]) for bone in facts["bones"])


def test_the_policy_allows_the_own_scripts_and_style_only(exported):
    page = Reader(exported[0].read_bytes())
    (policy,) = [a["content"] for _, a in page.elements if a.get("http-equiv") == "Content-Security-Policy"]
    assert policy is not None
    rules = {rule.split()[0]: rule.split()[1:] for rule in policy.split(";")}
    digests = [f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'" for text in page.scripts()]
    assert rules["script-src"] == digests
    assert rules["default-src"] == rules["base-uri"] == rules["form-action"] == ["'none'"]
    assert len(rules["style-src"]) == 1
    addresses = [attributes[name] for _, attributes in page.elements for name in ("src", "href") if name in attributes]
    assert addresses == ["data:,"]


def test_three_js_is_there_with_its_licence(exported):
    three, _ = Reader(exported[0].read_bytes()).scripts()
    license_text = (PAGE / "three.LICENSE").read_text(encoding="utf-8")
    assert "three.js authors" in license_text
    assert license_text in three[:2000]
    assert "</script" not in three


def test_the_bundle_is_of_the_version_and_has_the_parts_that_are_used():
    """Made again by tools/bundle_three.sh."""
    versions = json.loads((Path(__file__).parents[1] / "readers" / "package.json").read_text())["dependencies"]
    assert f"three.js {versions['three']}," in (PAGE / "three.min.js").read_text(encoding="utf-8")[:200]
    (used,) = re.findall(r"const \{([^}]+)\} = SnarfThree;", (PAGE / "viewer.js").read_text(encoding="utf-8"))
    exported = re.findall(r"export \{([^}]+)\}", (PAGE / "three.entry.mjs").read_text(encoding="utf-8"))
    assert set(re.findall(r"\w+", used)) == set(re.findall(r"\w+", " ".join(exported)))


def test_title_and_licence_are_chosen_or_those_of_the_data(exported, tmp_path):
    page = exported[0].read_text(encoding="utf-8")
    assert "Licence: CC0 1.0" in page
    toy = ToyCharacter()
    options = CharacterOptions(triangles=300, resolution=32, morph_targets=0)
    export_html(toy, tmp_path / "a.html", [Clip(wave(2))], options, HtmlConfig("My worm", "All rights reserved."))
    page = (tmp_path / "a.html").read_text(encoding="utf-8")
    assert "<h1>My worm</h1>" in page
    assert "<p>Licence: All rights reserved.</p>" in page
    report = Avatar.export_html(toy, tmp_path / "b.html", wave(1), triangles=300, resolution=32, morph_targets=0)
    page = (tmp_path / "b.html").read_text(encoding="utf-8")
    assert report.clips[0].frames == 1
    assert "<h1>worm</h1>" in page
    assert "Licence: None is stated" in page


def test_what_does_not_fit_is_reduced_and_said(monkeypatch, tmp_path):
    monkeypatch.setattr(html_export, "room_in_page", lambda most: 13_000)  # compression gives twice as much
    toy, whole = ToyCharacter(), CharacterOptions(triangles=None, resolution=40, morph_targets=2)
    report, notes = export_html(toy, tmp_path / "a.html", [Clip(wave(241))], whole)
    assert report.clips[0].frames == 121
    assert notes == [
        "the motions have 12 frames per second, so that they fit into the page",
        f"the mesh has {report.triangles} triangles, as many as fit into the page beside the motions",
    ]
    assert len(Reader((tmp_path / "a.html").read_bytes()).character()) <= 26_000


def test_what_is_not_compressed_enough_is_made_again_with_less(monkeypatch, tmp_path, caplog):
    toy, whole = ToyCharacter(), CharacterOptions(triangles=None, resolution=40, morph_targets=2)
    room, own = 26_000, -room_in_page(0) * 4 // 3  # bytes for a character, and of a page without one
    monkeypatch.setattr(html_export, "room_in_page", lambda most: room)
    monkeypatch.setattr(html_export, "MOST_BYTES", own + room * 4 // 3)
    monkeypatch.setattr("snarfcli.export.html_page.gzip.compress", lambda content, *rest, **more: content)
    with caplog.at_level(logging.INFO):
        report, _ = export_html(toy, tmp_path / "a.html", [Clip(wave(31))], whole)
    assert "it is made again with less" in caplog.text
    assert report.num_bytes == (tmp_path / "a.html").stat().st_size <= html_export.MOST_BYTES
    (tmp_path / "a.html").unlink()
    monkeypatch.setattr(html_export, "MOST_BYTES", 100_000)
    with pytest.raises(UserError, match=r"format=html: wanted at most 0.1 MB, got 0.7; give fewer motions"):
        export_html(toy, tmp_path / "a.html", [Clip(wave(2))], whole)
    with pytest.raises(UserError, match="clips: wanted at least one motion"):
        export_html(toy, tmp_path / "a.html", [], whole)
    assert list(tmp_path.iterdir()) == []


def test_a_page_is_as_large_as_planned():
    """Content that cannot be compressed, with long names."""
    limit = 2_000_000
    content = np.random.default_rng(0).bytes(room_in_page(limit))
    facts = {"clips": ["c" * 80] * 10, "bones": [{"name": "b" * 80, "color": "#123456"}] * 60}
    assert len(page_of(content, PageTexts("t" * 999, "s", "l" * 999), facts)) <= limit
