"""Learn an animatable avatar of one subject from posed meshes (SNARF, ICCV 2021; Fast-SNARF, PAMI 2023).

`snarf` is another name of the package `snarfcli`: `snarf.deformer` is the module `snarfcli.deformer`, which is loaded once.
The files beside this one are for tools that read code without running it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import snarfcli
from snarf._same_modules import share_modules

if TYPE_CHECKING:
    from snarfcli import *  # noqa: F403

__version__ = snarfcli.__version__
__all__: list[str] = []
__all__ += snarfcli.__all__

share_modules("snarf", "snarfcli")


def __getattr__(name: str) -> Any:
    if name.startswith("__"):
        raise AttributeError(f"module 'snarf' has no attribute {name!r}")
    try:
        return getattr(snarfcli, name)
    except AttributeError:
        raise AttributeError(f"module 'snarf' has no attribute {name!r}") from None


def __dir__() -> list[str]:
    return dir(snarfcli)
