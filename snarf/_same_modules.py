"""Import the modules of a package under a second name, without executing any of them twice."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence
from importlib.abc import InspectLoader, MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from types import CodeType, ModuleType
from typing import Any

__all__ = ["share_modules"]


def share_modules(alias: str, package: str) -> None:
    """Make `import ALIAS.NAME` give the module PACKAGE.NAME, except for names that begin with an underscore."""
    sys.meta_path.insert(0, _Finder(alias, package))


class _Finder(MetaPathFinder):
    """Finds modules by the alias. Stands before the others, which would find the files of the alias."""

    def __init__(self, alias: str, package: str) -> None:
        self.alias, self.package = alias, package

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        start, _, rest = fullname.partition(".")
        if start != self.alias or not rest or rest.startswith("_"):
            return None
        original = find_spec(f"{self.package}.{rest}")
        if original is None:
            return None
        spec = ModuleSpec(fullname, _Loader(original), origin=original.origin)
        spec.submodule_search_locations = original.submodule_search_locations
        return spec


class _Loader(InspectLoader):
    """Loads a module by its own name, and puts it in the place of the one that was to be made under the alias."""

    def __init__(self, original: ModuleSpec) -> None:
        self.original = original

    def create_module(self, spec: ModuleSpec) -> None:
        """Return None: Python makes a module, which `exec_module` replaces."""

    def exec_module(self, module: ModuleType) -> None:
        sys.modules[module.__name__] = importlib.import_module(self.original.name)

    def is_package(self, fullname: str) -> bool:
        return self.original.submodule_search_locations is not None

    def get_source(self, fullname: str) -> str | None:
        return self._inspect("get_source")

    def get_code(self, fullname: str) -> CodeType | None:
        return self._inspect("get_code")

    def _inspect(self, method: str) -> Any:
        """Call a method of the module's own loader, which in an editable install need not be an `InspectLoader`."""
        function = getattr(self.original.loader, method, None)
        if function is None:
            raise ImportError(f"the source of {self.original.name} cannot be read", name=self.original.name)
        return function(self.original.name)
