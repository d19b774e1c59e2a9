"""The page of an avatar in headless Chromium; skipped without it."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from chromium_page import Page, needs_chromium, opened
from PIL import Image
from toy_character import JOINTS, ToyCharacter, wave

from snarfcli.export.character import CharacterOptions
from snarfcli.export.clips import Clip
from snarfcli.export.html import export_html

HOSTILE = "</script></title><script>window.hacked = 1</script><img src=x onerror='window.hacked = 1'>{{three}}"
BACKGROUND = (0xD9, 0xDD, 0xE1)
READY = "!document.getElementById('controls').hidden"


@pytest.fixture(scope="module")
def path(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("html") / "worm.html"
    toy = ToyCharacter()
    toy.facts = {"subject": HOSTILE}
    names = [f"{HOSTILE}{number}" for number in range(JOINTS)]
    clips = [Clip(wave()), Clip(wave(25, HOSTILE, -0.7))]
    export_html(toy, path, clips, CharacterOptions(triangles=600, resolution=40), joint_names=names)
    return path


def set_input(page: Page, name: str, value: float, event: str) -> None:
    page.run(f"(e => {{ e.value = {value}; e.dispatchEvent(new Event('{event}')); }})(document.getElementById('{name}'))")


def click(page: Page, name: str) -> None:
    page.run(f"document.getElementById('{name}').click()")


def text(page: Page, name: str) -> str:
    return page.run(f"document.getElementById('{name}').textContent")


def drawn(page: Page) -> np.ndarray:
    """Return the middle of the next picture [H, W, 3], without texts and controls."""
    page.run("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
    return np.asarray(Image.open(io.BytesIO(page.picture())).convert("RGB")).astype(int)[150:480, 100:700]


def vividness(picture: np.ndarray) -> np.ndarray:
    """Return the difference of the largest and the smallest channel of each pixel."""
    return np.ptp(picture, axis=2)


def changed(a: np.ndarray, b: np.ndarray) -> float:
    """Return the share of pixels that differ clearly."""
    return float((np.abs(a - b).max(2) > 40).mean())


@needs_chromium
def test_the_page_plays_without_errors_and_without_a_network(path, tmp_path):
    with opened(path.as_uri(), tmp_path / "profile") as page:
        page.wait(READY)
        assert page.run("document.title.startsWith('</script>')")
        before = text(page, "time")
        page.wait(f"document.getElementById('time').textContent !== '{before}'")  # it plays
        click(page, "play")
        assert text(page, "play") == "Play"
        set_input(page, "scrubber", 0.1, "input")
        clay = drawn(page)
        assert text(page, "time") == "0.10 / 0.50 s"
        assert (np.abs(clay - BACKGROUND).max(2) > 40).mean() > 0.02  # there is a body
        set_input(page, "scrubber", 0.4, "input")
        assert changed(clay, drawn(page)) > 0.01  # which moves
        set_input(page, "scrubber", 0.1, "input")
        assert changed(clay, drawn(page)) < 1e-3  # and comes back
        assert page.run("document.getElementById('bones').hidden")
        click(page, "weights")
        box = "document.getElementById('{}').getBoundingClientRect().{}"
        for width in ("auto", "200px"):  # the controls become higher without another size of the window
            page.run(f"document.getElementById('controls').style.width = '{width}'")
            drawn(page)
            assert page.run(f"{box.format('bones', 'bottom')} <= {box.format('controls', 'top')}")
        page.run("document.getElementById('controls').style.width = 'auto'")
        coloured = drawn(page)
        assert np.quantile(vividness(coloured), 0.99) > 2 * np.quantile(vividness(clay), 0.99)
        assert page.run("document.getElementById('bones').children.length") == JOINTS
        click(page, "skeleton")
        assert 1e-4 < changed(coloured, drawn(page)) < 0.1
        set_input(page, "clip", 1, "change")
        page.wait("document.getElementById('time').textContent.endsWith('/ 1.00 s')")
        set_input(page, "speed", 2, "change")
        click(page, "play")
        page.wait("!document.getElementById('time').textContent.startsWith('0.00')")
        page.run("document.body.dispatchEvent(new KeyboardEvent('keydown', { key: ' ', bubbles: true }))")
        assert text(page, "play") == "Play"
        assert page.run("window.hacked") is None
        assert page.complaints == []
        assert page.requests == [path.as_uri()]


@needs_chromium
def test_the_browser_refuses_what_the_page_does_not_need(path, tmp_path):
    with opened(path.as_uri(), tmp_path / "profile") as page:
        page.wait(READY)
        page.run("document.body.insertAdjacentHTML('beforeend', '<img src=x onerror=\"window.hacked = 1\">')")
        page.run("document.body.append(Object.assign(document.createElement('script'), { textContent: 'window.hacked = 1' }))")
        assert page.run("fetch('http://127.0.0.1:9/').then(() => 'sent', () => 'refused')") == "refused"
        assert page.run("window.hacked") is None
        assert sum("Content Security Policy" in complaint for complaint in page.complaints) >= 3, page.complaints


@needs_chromium
def test_what_cannot_be_shown_is_said(path, tmp_path):
    content = path.read_text(encoding="utf-8")
    begin = content.index('id="avatar">') + len('id="avatar">')
    (tmp_path / "broken.html").write_text(content[:begin] + "AAAA" + content[begin + 4 :], encoding="utf-8")
    with opened((tmp_path / "broken.html").as_uri(), tmp_path / "profile") as page:
        page.wait("document.getElementById('message').textContent.startsWith('The avatar cannot be shown: ')")
        assert len(page.complaints) == 1
