"""The page in a real browser, Chromium without a window: optional, since it takes a browser and playwright."""

from __future__ import annotations

import io
import shutil
import threading
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from toy_avatar import ToyAvatar
from toy_viewer import SMALL

from snarfcli.motions import Motion
from snarfcli.viewer.server import ViewServer

viser = pytest.importorskip("viser", reason="the viewer needs viser: pip install 'snarf[view]'")
playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright: pip install playwright")
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None)
if CHROMIUM is None:
    pytest.skip("needs Chromium or Chrome", allow_module_level=True)

# WebGL by the processor: no GPU is needed.
_FLAGS = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox")
_BODY = {"x": 100, "y": 100, "width": 500, "height": 400}  # of the window, left of the panel
_PATIENCE_MS = 300_000


def load_motion(name: str):
    poses = np.zeros((60, 2, 3))
    poses[:, 1, 2] = np.linspace(0, 0.9, 60)
    return Motion(name, poses, np.zeros((60, 3)), 30.0), None


ATTACK = "{window.attacked = 1} <img src=x onerror='window.attacked = 1'>"

# A page of another origin that tries to open the viewer's WebSocket and to read its page.
FOREIGN = """<body><script>
async function attack(port, protocol) {
  const opened = await new Promise(done => {
    const socket = new WebSocket(`ws://127.0.0.1:${port}`, [protocol]);
    socket.onopen = () => done(true);
    socket.onerror = () => done(false);
  });
  const read = await fetch(`http://127.0.0.1:${port}/`).then(() => true, () => false);
  return [opened, read];
}
</script></body>"""


@pytest.fixture(params=["127.0.0.1", "0.0.0.0"])
def page(request):
    look = replace(SMALL, weight_colors=True)
    facts = {"subject": ATTACK}
    server = ViewServer(ToyAvatar(), look, host=request.param, motions=["bend"], load_motion=load_motion, facts=facts)
    with playwright.sync_playwright() as program:
        browser = program.chromium.launch(executable_path=CHROMIUM, args=list(_FLAGS))
        page = browser.new_page(viewport={"width": 1000, "height": 600})
        page.set_default_timeout(_PATIENCE_MS)
        page.foreign = []
        page.on("request", lambda request: page.foreign.append(request.url) if _is_foreign(request.url) else None)
        page.on("pageerror", lambda error: page.foreign.append(str(error)))
        page.goto(server.address)
        page.server = server
        yield page
        browser.close()
    server.stop()


def _is_foreign(url: str) -> bool:
    return not url.startswith(("http://127.0.0.1", "ws://127.0.0.1", "data:", "blob:"))


def colored_share(page) -> float:
    """Return the share of the picture that has a colour, as only the body has: floor and shadow are grey."""
    picture = np.asarray(Image.open(io.BytesIO(page.screenshot(clip=_BODY))).convert("RGB")).astype(int)
    return float((np.ptp(picture, axis=2) > 60).mean())


def test_the_body_is_seen_posed_and_played_and_nothing_comes_from_elsewhere(page):
    page.get_by_text("344 vertices").wait_for()
    page.wait_for_function("document.querySelector('canvas') !== null")
    shares = [0.0]
    while shares[-1] < 0.01 and len(shares) < 100:  # each look takes a while, and the page fades in
        shares.append(colored_share(page))
    assert shares[-1] > 0.01
    page.get_by_text("Pose", exact=True).click()
    turned = threading.Event()
    turn_joint = page.server.state.turn_joint

    def turn(*arguments) -> None:
        turn_joint(*arguments)
        turned.set()

    page.server.state.turn_joint = turn
    inputs = page.locator("input:visible")
    inputs.nth(3).fill("40")  # after the joint, x and y
    inputs.nth(3).press("Enter")
    assert turned.wait(_PATIENCE_MS / 1000)
    assert page.server.state.posed.pose[1] == pytest.approx([0, 0, np.radians(40)])

    page.get_by_text("Motion", exact=True).first.click()
    inputs.first.click()
    page.get_by_text("bend", exact=True).click()
    page.get_by_text("Pause").click()
    page.get_by_text("Play", exact=True).wait_for()
    assert page.server.state.motion.name == "bend"
    assert not page.server.state.player.is_playing
    assert not page.foreign
    assert page.evaluate("window.attacked") is None  # though the avatar's facts are code
    assert "token" not in page.url

    foreign = page.context.browser.new_page()
    foreign.route("http://127.0.0.1:9/", lambda route: route.fulfill(body=FOREIGN, content_type="text/html"))
    foreign.goto("http://127.0.0.1:9/")
    assert foreign.evaluate(f"attack({page.server.port}, 'viser-v{viser.__version__}')") == [False, False]
