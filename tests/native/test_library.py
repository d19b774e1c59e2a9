"""Loading of the native library: it is loaded here, and any problem with it is reported as a reason, not a crash."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import warnings

import pytest

from snarfcli.native import backend, library
from snarfcli.native.backend import choose_backend


@pytest.fixture
def fresh(monkeypatch):
    """Load anew, in the test and after it."""

    def forget():
        library._load.cache_clear()
        backend._warn_once.cache_clear()

    forget()
    yield monkeypatch
    monkeypatch.undo()
    forget()


@pytest.fixture
def no_library(fresh, tmp_path):
    """Look in an empty folder only."""
    fresh.delenv("SNARF_NATIVE_LIBRARY", raising=False)
    fresh.setattr(library, "_folders", lambda: [tmp_path])
    return tmp_path


def test_the_native_library_is_loaded_here():
    """Otherwise every other test would pass on the reference, unnoticed."""
    assert library.native_library() is not None, library.why_unavailable()
    assert library.why_unavailable() is None
    assert library.library_path().is_file()
    assert library.instruction_set() in ("avx512", "avx2", "baseline")
    assert choose_backend("auto") == choose_backend("native") == "native"
    assert library.native_library() is library.native_library()


def test_importing_loads_nothing():
    code = (
        "import snarfcli, snarfcli.deformer; from snarfcli.native import library; "
        "assert library._load.cache_info().currsize == 0; library.native_library(); "
        "assert library._load.cache_info().currsize == 1"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_backend_names():
    with pytest.raises(ValueError, match="backend: wanted auto, native or reference, got 'fast'"):
        choose_backend("fast")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert choose_backend("reference") == "reference"


def test_without_a_library_auto_warns_once_and_native_raises(no_library):
    with pytest.warns(RuntimeWarning, match=f"references in PyTorch.*there is no .* in {no_library}") as caught:
        chosen = [choose_backend("auto") for _ in range(2)]
    assert chosen == ["reference", "reference"]
    assert len(caught) == 1
    assert caught[0].filename == __file__
    with pytest.raises(RuntimeError, match="backend native is not available: there is no"):
        choose_backend("native")
    assert library.native_library() is library.library_path() is library.instruction_set() is None
    assert library.build_note() == {}


def test_a_device_without_kernels_is_named(fresh):
    with pytest.warns(RuntimeWarning, match="references in PyTorch.*there are no kernels for tensors on mps") as caught:
        chosen = [choose_backend("auto", "mps") for _ in range(2)]
    assert chosen == ["reference", "reference"]
    assert len(caught) == 1
    with pytest.raises(RuntimeError, match="backend native is not available: there are no kernels for tensors on xpu"):
        choose_backend("native", "xpu")


def test_the_reason_noted_by_the_build_is_told(no_library):
    (no_library / "native_build.json").write_text(json.dumps({"built": False, "reason": "no compiler was found"}))
    assert library.why_unavailable().startswith("no compiler was found; install a C++17 compiler (")
    assert "then reinstall snarf" in library.why_unavailable()


def test_a_broken_note_is_passed_over(no_library):
    (no_library / "native_build.json").write_text("[1, ")
    assert library.build_note() == {}
    assert "there is no" in library.why_unavailable()


def test_the_variable_names_another_library(fresh, tmp_path):
    copy = tmp_path / "copy.so"
    shutil.copy(library.library_path(), copy)
    library._load.cache_clear()
    fresh.setenv("SNARF_NATIVE_LIBRARY", str(copy))
    assert library.library_path() == copy
    assert library.why_unavailable() is None


def test_a_wrong_variable_is_named(fresh):
    fresh.setenv("SNARF_NATIVE_LIBRARY", "/nowhere/lib.so")
    assert library.native_library() is None
    assert library.why_unavailable() == "SNARF_NATIVE_LIBRARY names /nowhere/lib.so, which is not a file; correct or unset it"


@pytest.mark.parametrize("size", [0, 63, 64, 200, 5_000, 50_000])
def test_a_library_that_ends_too_early_is_a_reason(fresh, tmp_path, size):
    """Loading one would end the process with a bus error. A whole library is larger, with any compiler."""
    content = library.library_path().read_bytes()
    library._load.cache_clear()
    (tmp_path / "short.so").write_bytes(content[:size])
    fresh.setenv("SNARF_NATIVE_LIBRARY", str(tmp_path / "short.so"))
    assert library.native_library() is None
    assert str(tmp_path / "short.so") in library.why_unavailable()


def test_a_file_that_is_no_library_is_a_reason(fresh, tmp_path):
    (tmp_path / "text.so").write_text("not a library, but long enough to have a header " * 4)
    fresh.setenv("SNARF_NATIVE_LIBRARY", str(tmp_path / "text.so"))
    assert library.why_unavailable().startswith("the native library cannot be loaded: ")


def test_another_library_is_a_reason(fresh):
    import numpy.fft._pocketfft_umath as other

    fresh.setenv("SNARF_NATIVE_LIBRARY", other.__file__)
    assert library.why_unavailable() == f"{other.__file__} is not a library of snarf"


def test_another_version_of_the_interface_is_a_reason(fresh):
    fresh.setattr(library, "ABI_VERSION", library.ABI_VERSION + 1)
    reason = library.why_unavailable()
    assert f"wanted version {library.ABI_VERSION} of the interface, got {library.ABI_VERSION - 1}; reinstall snarf" in reason
