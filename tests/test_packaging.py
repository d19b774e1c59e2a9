"""The wheel: what it holds, that it runs from anywhere, with and without a C++ compiler, and what the library exports."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest
from filelock import FileLock

ROOT = Path(__file__).parents[1]
NEEDS_NM = pytest.mark.skipif(
    sys.platform != "linux" or not shutil.which("nm"), reason="reads ELF files with nm of the binutils"
)


def build_wheel(folder: Path, checkout: Path = ROOT, **environment: str) -> Path:
    """Build the wheel of a checkout into an empty folder. Settings go through the environment: pip < 22.1 has no option."""
    command = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation", "-w", str(folder)]
    done = subprocess.run([*command, str(checkout)], env=os.environ | environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    (wheel,) = folder.glob("snarf-*.whl")
    return wheel


@pytest.fixture(scope="session")
def wheel(tmp_path_factory) -> Path:
    """The wheel, built once for all processes of the test run, in the checkout's build folder: little is compiled again."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "wheel"
    with FileLock(f"{folder}.lock"):
        found = list(folder.glob("snarf-*.whl"))
        return found[0] if found else build_wheel(folder)


def unpack(wheel: Path, folder: Path) -> list[str]:
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder)
        return archive.namelist()


def run_from(site: Path, code: str) -> subprocess.CompletedProcess[str]:
    """Run code with the unpacked wheel and the installed dependencies, without `site`, whose hooks would find the checkout."""
    tests = ROOT / "tests"
    paths = [str(site), *(path for path in sys.path if path and Path(path) != ROOT and not Path(path).is_relative_to(tests))]
    begin = f"import sys; sys.path[1:1] = {paths!r}; import snarfcli; assert {str(site)!r} in snarfcli.__file__; "
    environment = {key: value for key, value in os.environ.items() if key != "SNARF_NATIVE_LIBRARY"}
    return subprocess.run([sys.executable, "-S", "-c", begin + code], cwd=site, env=environment, capture_output=True, text=True)


def test_the_wheel_holds_what_is_needed_at_run_time(wheel, tmp_path):
    assert re.fullmatch(r"snarf-[\d.]+-py3-none-(?!any)\w+\.whl", wheel.name)
    names = set(unpack(wheel, tmp_path))
    configuration = {f"snarfcli/conf/{path.relative_to(ROOT / 'conf').as_posix()}" for path in (ROOT / "conf").rglob("*.yaml")}
    kernels = [path for folder in ("include/snarf", "cuda") for path in (ROOT / "csrc" / folder).iterdir()]
    sources = {f"snarfcli/{path.relative_to(ROOT).as_posix()}" for path in kernels}
    modules = {path.relative_to(ROOT).as_posix() for name in ("snarf", "snarfcli") for path in (ROOT / name).rglob("*.py")}
    assert configuration
    assert sources
    others = {"snarf/py.typed", "snarfcli/py.typed", "snarfcli/bodies/body_cc0.npz"}
    others |= {f"snarfcli/export/page/{path.name}" for path in (ROOT / "snarfcli/export/page").iterdir()}
    assert configuration | sources | modules | others <= names
    assert [name for name in names if "libsnarf_native" in name] == [_native_name()]
    assert all(name.startswith(("snarf/", "snarfcli/", "snarf-")) for name in names)
    assert not [name for name in names if "__pycache__" in name or name.endswith((".o", ".a", ".cpp"))]


def _native_name() -> str:
    from snarfcli.native import library

    return f"snarfcli/native/{library._FILE_NAME}"


def test_the_wheel_runs_from_anywhere(wheel, tmp_path):
    unpack(wheel, tmp_path)
    (stated,) = re.findall(r'^version = "(.+)"$', (ROOT / "pyproject.toml").read_text(), re.MULTILINE)
    done = run_from(
        tmp_path,
        f"assert snarfcli.__version__ == {stated!r}; import snarf; assert {str(tmp_path)!r} in snarf.__file__; "
        "from snarf.deformer import ForwardDeformer; assert ForwardDeformer is snarfcli.ForwardDeformer; "
        "from snarfcli.bodies import builtin_body; assert len(builtin_body().v_template) == 6890; "
        "from snarfcli.native.backend import choose_backend; from snarfcli.native.library import library_path; "
        f"assert choose_backend('native') == 'native' and {str(tmp_path)!r} in str(library_path()); "
        "from snarfcli.cli.main import main; raise SystemExit(main(['train', '--cfg', 'job']))",
    )
    assert done.returncode == 0, done.stderr
    assert "subject: '50002'" in done.stdout


def test_without_a_compiler_the_wheel_runs_on_the_reference_with_one_warning(tmp_path):
    folder = tmp_path / "wheel"
    compilers = {"CC": "/nonexistent/cc", "CXX": "/nonexistent/c++"}
    names = unpack(build_wheel(folder, SKBUILD_BUILD_DIR=str(tmp_path / "build"), **compilers), tmp_path / "site")
    assert not [name for name in names if "libsnarf_native" in name]
    done = run_from(
        tmp_path / "site",
        "import torch; from snarfcli.deformer import CanonicalGrid, find_correspondences; from snarfcli.native import backend; "
        "grid = CanonicalGrid(torch.tensor([-1.0] * 3), torch.tensor([1.0] * 3)); points = torch.full((1, 5, 3), 0.3); "
        "found = [find_correspondences(points, torch.eye(4)[None, None], torch.ones(3, 3, 3, 1), grid) for _ in range(2)]; "
        "assert found[1].query.tolist() == [0, 1, 2, 3, 4] and backend.choose_backend('auto') == 'reference'",
    )
    assert done.returncode == 0, done.stderr
    warning = "no working C++ compiler was found when snarf was installed; install a C++17 compiler"
    assert done.stderr.count("Warning") == done.stderr.count(warning) == 1


def test_a_source_that_does_not_compile_leaves_the_library_out(tmp_path):
    """As with an untested compiler: the build goes on without the library."""
    copy = tmp_path / "checkout"
    shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns(".*", "build", "data", "outputs", "tests", "*.so"))
    (copy / "csrc/cpu/library.cpp").write_text("#error no such compiler\n")
    for kernel in copy.glob("csrc/cpu/kernel*.cpp"):
        kernel.write_text("")
    unpack(build_wheel(tmp_path / "wheel", copy), tmp_path / "site")
    done = run_from(tmp_path / "site", "from snarfcli.native.backend import choose_backend; choose_backend('auto')")
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("Warning") == 1
    assert "reinstall snarf with a C++ compiler" in done.stderr


def test_the_source_distribution_builds(tmp_path):
    code = "import sys; from scikit_build_core.build import build_sdist; build_sdist(sys.argv[1])"
    subprocess.run([sys.executable, "-c", code, str(tmp_path)], cwd=ROOT, check=True, capture_output=True)
    (archive,) = tmp_path.glob("snarf-*.tar.gz")
    with tarfile.open(archive) as file:
        names = {name.partition("/")[2] for name in file.getnames()}
    folders = ("csrc", "conf", "examples", "snarf", "snarfcli", "tests")
    wanted = [path for folder in folders for path in (ROOT / folder).rglob("*") if path.is_file()]
    wanted = {path.relative_to(ROOT).as_posix() for path in wanted if "__pycache__" not in path.parts}
    assert wanted | {"CMakeLists.txt", "pyproject.toml", "README.md", "LICENSE", "Makefile", "tools/set_up.sh"} <= names


def defined_symbols(file: Path, *flags: str) -> set[str]:
    """Return the mangled names of the external symbols that an object file or library defines."""
    command = ["nm", "--defined-only", "--extern-only", "--format=posix", *flags, str(file)]
    lines = subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()
    return {line.split()[0] for line in lines if line.strip()}


@NEEDS_NM
def test_the_library_exports_its_interface_only(wheel, tmp_path):
    unpack(wheel, tmp_path)
    symbols = defined_symbols(tmp_path / _native_name(), "--dynamic")
    assert {"snarf_abi_version", "snarf_instruction_set"} <= symbols
    assert all(name.startswith("snarf_") for name in symbols)


@NEEDS_NM
@pytest.mark.parametrize("isa", ["baseline", "avx2", "avx512"])
def test_kernels_define_nothing_outside_their_namespace(wheel, isa):
    """The linker merges functions of the same name: a std::vector compiled for AVX-512 would crash on other processors."""
    objects = list((ROOT / "build").glob(f"py3-none-*/CMakeFiles/snarf_kernels_{isa}.dir/**/*.o"))
    if not objects and isa != "baseline":
        pytest.skip(f"this processor or compiler has no {isa}")
    assert objects
    # Functions, statics, guards and tables of namespace snarf::<isa>, as the Itanium ABI mangles them.
    own = re.compile(rf"_Z(TV|TI|TS|GV|GR|Z)*N[KVRO]*5snarf{len(isa)}{isa}")
    names = {name for file in objects for name in defined_symbols(file)}
    foreign = [name for name in names if not own.match(name) and not name.startswith("DW.ref.")]  # DW.ref: a pointer
    assert foreign == []
