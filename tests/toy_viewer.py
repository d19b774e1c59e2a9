"""A viewer of the toy avatar with a clock set by the test; it waits for surfaces without sleeping."""

from __future__ import annotations

import threading

from toy_avatar import ToyAvatar

from snarfcli.viewer.body import ViewerBody
from snarfcli.viewer.picture import Picture, ViewerLook
from snarfcli.viewer.state import ViewerState

PATIENCE_S = 300  # only a broken test waits that long, however busy the machine is
SMALL = ViewerLook(skinned_resolution=24, field_resolution=24)


class Watched:
    """A viewer without a page, whose pictures a test asks for."""

    def __init__(self, avatar: ToyAvatar | None = None, look: ViewerLook = SMALL) -> None:
        self.now = 0.0
        self.woken = threading.Event()
        self.avatar = avatar or ToyAvatar()
        self.state = ViewerState(ViewerBody(self.avatar), look, self.woken.set, lambda: self.now)

    def picture(self) -> Picture:
        return self.state.picture()[0]

    def settled(self) -> Picture:
        """Return the picture once all surfaces are computed."""
        while True:
            self.woken.clear()
            picture = self.picture()
            if not picture.is_computing:
                return picture
            assert self.woken.wait(PATIENCE_S)
