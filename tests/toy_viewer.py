"""A viewer of the toy avatar whose clock the test turns, and which waits for surfaces without sleeping."""

from __future__ import annotations

import threading

from toy_avatar import ToyAvatar

from snarfcli.viewer.body import ViewerBody
from snarfcli.viewer.picture import Picture, ViewerLook
from snarfcli.viewer.state import ViewerState

PATIENCE_S = 300  # only a broken test waits that long, however busy the machine is
SMALL = ViewerLook(skinned_resolution=24, field_resolution=24)


class Watched:
    """What a page would do: look at the picture whenever it is woken."""

    def __init__(self, avatar: ToyAvatar | None = None, look: ViewerLook = SMALL) -> None:
        self.now = 0.0
        self.woken = threading.Event()
        self.avatar = avatar or ToyAvatar()
        self.state = ViewerState(ViewerBody(self.avatar), look, self.woken.set, lambda: self.now)

    def picture(self) -> Picture:
        return self.state.picture()[0]

    def settled(self) -> Picture:
        """Return the picture once nothing more is being made."""
        while True:
            self.woken.clear()
            picture = self.picture()
            if not picture.is_computing:
                return picture
            assert self.woken.wait(PATIENCE_S)
