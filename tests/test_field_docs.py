"""help() of public dataclasses shows what each field means; the commands' help reads the same texts."""

from __future__ import annotations

import dataclasses
import inspect
import pydoc
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import pytest

import snarfcli.deformer
from snarfcli.bodies import MeshTemplate, Skeleton
from snarfcli.export.character import CharacterOptions
from snarfcli.export.clips import Clip
from snarfcli.field_docs import documented, field_texts
from snarfcli.hydra_config.schema import describe
from snarfcli.motions import Motion

OF_DEFORMER = [
    value for value in vars(snarfcli.deformer).values() if inspect.isclass(value) and dataclasses.is_dataclass(value)
]
OTHERS = [CharacterOptions, Clip, MeshTemplate, Motion, Skeleton]


def shown(kind: type) -> str:
    """Return what help() prints, with each run of spaces and bars as one space."""
    return " ".join(pydoc.render_doc(kind, renderer=pydoc.plaintext).replace("|", " ").split())


@pytest.mark.parametrize("kind", OF_DEFORMER + OTHERS, ids=lambda kind: kind.__name__)
def test_help_shows_every_field(kind):
    texts = field_texts(kind)
    assert texts.keys() >= {field.name for field in dataclasses.fields(kind)}
    summary = shown(kind)
    for name, text in texts.items():
        assert f" {name}: {text} " in summary
    assert not summary.split(" Attributes: ")[0].endswith("None")


def test_the_deformers_classes_are_among_them():
    names = {"CanonicalGrid", "Correspondences", "NodeWeights", "SearchConfig", "SkinningConfig"}
    assert names <= {kind.__name__ for kind in OF_DEFORMER}


@documented
@dataclasses.dataclass
class Base:
    """A base class.

    More about it.
    """

    size: float = 1.0
    """Size, metres."""
    _hidden: int = 0
    plain: int = 0


@documented
@dataclasses.dataclass
class Derived(Base):
    """A derived class."""

    count: int = 2
    """Number of things; a description that is longer than one line of help is, so that it has to be broken into several of them
    somewhere."""


def test_the_section_is_indented_and_wrapped():
    assert Base.__doc__ == "A base class.\n\nMore about it.\n\nAttributes:\n    size: Size, metres."
    lines = str(Derived.__doc__).splitlines()
    assert lines[:4] == ["A derived class.", "", "Attributes:", "    size: Size, metres."]
    assert lines[4].startswith("    count: Number of things;")
    assert lines[5].startswith("        ")
    assert max(len(line) for line in lines) <= 100
    assert Derived(count=3).__doc__ == Derived.__doc__
    assert list(describe(Derived)) == [
        ("size", "Size, metres."),
        ("_hidden", ""),
        ("plain", ""),
        *list(field_texts(Derived).items())[1:],
    ]


def test_without_source_the_docstring_stays():
    space: dict[str, Any] = {"__name__": __name__}
    exec(
        "import dataclasses\n@dataclasses.dataclass\nclass Made:\n    '''A class.'''\n    x: int = 0\n    '''Number.'''", space
    )
    made = documented(space["Made"])
    assert made.__doc__ == "A class."
    assert field_texts(made) == {}


SCRIPT = """
import pydoc, sys
sys.path.insert(0, sys.argv[1])
from shapes import Shape
print(Shape.__doc__)
"""
SOURCE = '''
from dataclasses import dataclass
from field_docs import documented

@documented
@dataclass
class Shape:
    """A shape."""

    size: float = 1.0
    """Size, metres."""
'''


@pytest.mark.parametrize(("flags", "kind"), [([], "folder"), ([], "zip"), (["-OO"], "folder"), (["-OO"], "zip")])
def test_zipped_and_without_docstrings(tmp_path, flags, kind):
    import snarfcli.field_docs

    files = {"shapes.py": SOURCE, "field_docs.py": Path(snarfcli.field_docs.__file__).read_text()}
    place = tmp_path / "modules.zip" if kind == "zip" else tmp_path
    if kind == "zip":
        with zipfile.ZipFile(place, "w") as archive:
            for name, text in files.items():
                archive.writestr(name, text)
    else:
        for name, text in files.items():
            (tmp_path / name).write_text(text)
    run = subprocess.run([sys.executable, *flags, "-c", SCRIPT, str(place)], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    first, *rest = run.stdout.splitlines()
    assert first.startswith("Shape(size: float = 1.0)" if flags else "A shape.")  # what dataclass itself writes
    assert rest == ["", "Attributes:", "    size: Size, metres."]
