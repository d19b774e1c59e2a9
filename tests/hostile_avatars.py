"""Files that a hostile author would give away as an avatar, by name, and the folders and records around them.

Each entry writes `avatar.pt` into a folder. Most must be refused; `HARMLESS` are strange, but mean an avatar.
"""

from __future__ import annotations

import copy
import io
import os
import pickle
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from estimates import rezipped
from tiny_avatars import saved, tiny_avatar

__all__ = ["HARMLESS", "SECRET_NAME", "hostile_avatars", "hostile_records"]

SECRET_NAME = "SNARF_TEST_SECRET"
"""Name of an environment variable that no output may show the value of."""

HARMLESS = (
    "facts interpolated", "facts subject escapes", "facts subject path", "facts subject html", "joint names escape",
    "joint names path", "extra key at the top", "weights file of the system", "facts empty", "text of a missing value in facts",
    "joint names equal", "steps of the search many", "symlink to a good file", "weights file interpolated",
    "a weight huge", "archive with a name that climbs",
)  # fmt: skip
"""Names of entries that can be loaded and used."""

_SECRET = "${oc.env:" + SECRET_NAME + "}"


def hostile_avatars() -> dict[str, Callable[[Path], object]]:
    """Return what writes each hostile avatar into a folder."""
    entries: dict[str, Callable[[Path], object]] = {}
    for name, change in {**_configs(), **_contents(), **_tensors()}.items():
        entries[name] = _changed(change)
    for name, data in {**_archives(), **_pickles()}.items():
        entries[name] = _writes(data)
    return {**entries, **_places(), **_systems()}


def _writes(data: bytes) -> Callable[[Path], object]:
    return lambda folder: (folder / "avatar.pt").write_bytes(data)


def _changed(change: Callable[[dict[str, Any]], object], kind: str = "fast_snarf") -> Callable[[Path], object]:
    def write(folder: Path) -> None:
        content = copy.deepcopy(_content(kind))
        change(content)
        (folder / "avatar.pt").write_bytes(saved(content))

    return write


_made: dict[str, dict[str, Any]] = {}


def _content(kind: str = "fast_snarf") -> dict[str, Any]:
    if kind not in _made:
        _made[kind] = tiny_avatar(kind).to_dict()
    return _made[kind]


def _sets(*path: str, value: Any) -> Callable[[dict[str, Any]], object]:
    def change(content: dict[str, Any]) -> None:
        for name in path[:-1]:
            content = content[name]
        content[path[-1]] = value

    return change


def _drops(*path: str) -> Callable[[dict[str, Any]], object]:
    def change(content: dict[str, Any]) -> None:
        for name in path[:-1]:
            content = content[name]
        del content[path[-1]]

    return change


def _configs() -> dict[str, Callable[[dict[str, Any]], object]]:
    """Return configurations that are resolved, huge, negative, of a wrong type, incomplete or too long."""
    texts = {
        "model": ("name", "blend"), "skinning": ("name", "softmax"), "search": ("name", "jacobian", "backend"),
        "shape": ("activation",), "condition": ("name",),
    }  # fmt: skip
    found = {
        f"{group}.{name} {kind}": _sets("config", group, name, value=value)
        for group, names in texts.items()
        for name in names
        for kind, value in (("interpolated", _SECRET), ("unknown", "\x1b[2J../../x"))
    }
    for kind, value in (
        ("interpolated", _SECRET), ("nested", "${oc.decode:${oc.env:" + SECRET_NAME + "}}"), ("itself",
        "${config.shape.width}"),
        ("missing", "???"), ("negative", -1), ("zero", 0), ("huge", 10**9), ("beyond", 2**63 - 1), ("a text", "6"),
        ("a list", [6]), ("a dict", {"_target_": "os.system"}), ("none", None), ("true", True), ("half", 6.5),
        ("nan", float("nan")),
        ("infinite", float("inf")),
    ):  # fmt: skip
        found[f"shape.width {kind}"] = _sets("config", "shape", "width", value=value)
    for group, name, value in (
        ("shape", "depth", 10**9), ("shape", "depth", -3), ("shape", "condition_size", 10**9), ("shape", "condition_layer", 99),
        ("shape", "frequencies", [1.0] * 100_000), ("shape", "frequencies", [float("nan")]), ("shape", "features", 10**6),
        ("shape", "feature_cells_m", [1e-4]), ("shape", "feature_cells_m", [-1.0]),
        ("shape", "feature_cells_m", [0.1] * 10_000), ("shape", "skip_layers", "all"), ("shape", "skip_layers", [1]),
        ("shape", "prior_radius_m", "wide"),
        ("skinning", "resolution", [2000, 2000, 2000]), ("skinning", "resolution", [5, 6]),
        ("skinning", "resolution", [0, 0, 0]), ("skinning", "resolution", [-5, -6, 4]), ("skinning", "width", 10**8),
        ("skinning", "depth", 10**9),
        ("skinning", "prior_falloff_m", []), ("search", "max_steps", 10**12), ("search", "max_steps", 0),
        ("search", "tolerance", -1.0), ("search", "init_bones", [0] * 10_000), ("search", "init_bones", [9]),
        ("condition", "size", 10**9), ("condition", "layer", -7), ("model", "components", "all"), ("model", "part_width", -1),
    ):  # fmt: skip
        found[f"{group}.{name} = {str(value)[:30]}"] = _sets("config", group, name, value=value)
    for other in ("snarf", "pose_onet", "back_lbs", "back_d", "nasa", "piecewise", "smpl_nn", "os.system", ""):
        found[f"another system: {other}"] = _sets("config", "model", "name", value=other)
    found["weights file of the system"] = _sets("config", "skinning", "weights_file", value="/etc/passwd")
    found["weights file interpolated"] = _sets("config", "skinning", "weights_file", value=_SECRET)
    found["steps of the search many"] = _sets("config", "search", "max_steps", value=500)
    for group in ("model", "skinning", "search", "shape"):
        found[f"no config.{group}"] = _drops("config", group)
        found[f"config.{group} a list"] = _sets("config", group, value=[])
    found["config a text"] = _sets("config", value=_SECRET)
    found["an unknown setting"] = _sets("config", "shape", "_target_", value="os.system")
    found["an unknown group"] = _sets("config", "hydra", value={"run": {"dir": "/"}})
    found["a name of ten megabytes"] = _sets("config", "model", "name", value="x" * 10**7)
    return found


def _contents() -> dict[str, Callable[[dict[str, Any]], object]]:
    """Return facts, skeletons, grids and versions that are wrong, missing, endless or dangerous to show."""
    found = {f"no {name}": _drops(name) for name in ("format", "version", "config", "skeleton", "grid", "state", "facts")}
    found |= {f"no skeleton.{name}": _drops("skeleton", name) for name in ("names", "parents", "joints_rest", "canonical_pose")}
    found |= {f"no grid.{name}": _drops("grid", name) for name in ("lower", "upper")}
    for name, value in (
        ("interpolated", _SECRET), ("escapes", "\x1b]0;x\x07\x1b[2J\r\n\u202eevil"), ("path", "../../../tmp/x"),
        ("html", "<script>alert(1)</script>[x](javascript:1)"),
    ):  # fmt: skip
        found["facts interpolated" if name == "interpolated" else f"facts subject {name}"] = _sets(
            "facts", "subject", value=value
        )
    found |= {
        "facts empty": _sets("facts", value={}),
        "text of a missing value in facts": _sets("facts", "data", value="???"),
        "facts a list": _sets("facts", value=[1]),
        "facts of half a surrogate pair": _sets("facts", "subject", value="\ud800"),
        "facts of a megabyte": _sets("facts", "subject", value="x" * 2**20),
        "facts nested 60 levels": _sets("facts", "deep", value=_nested(60)),
        "facts that double 40 times": _sets("facts", "deep", value=_doubled(40)),
        "facts that contain themselves": _sets("facts", "deep", value=_circular()),
        "facts with a tensor": _sets("facts", "steps", value=torch.zeros(3)),
        "extra key at the top": _sets("_target_", value="os.system"),
        "format of another program": _sets("format", value="\x1b[31mother"),
        "format a tensor": _sets("format", value=torch.zeros(2)),
        "version as text": _sets("version", value=_SECRET),
        "version of many digits": _sets("version", value=2**62),
        "joint names escape": _sets("skeleton", "names", value=["\x1b[2J", "a\nb", "c"]),
        "joint names path": _sets("skeleton", "names", value=["../../a", "/etc/passwd", "C:\\x"]),
        "joint names equal": _sets("skeleton", "names", value=["a", "a", "a"]),
        "joint names numbers": _sets("skeleton", "names", value=[1, 2, 3]),
        "joint names too few": _sets("skeleton", "names", value=["a"]),
        "parents in a circle": _sets("skeleton", "parents", value=[-1, 2, 1]),
        "parents beyond": _sets("skeleton", "parents", value=[-1, 0, 99]),
        "parents negative": _sets("skeleton", "parents", value=[-1, -9, 1]),
        "parents a text": _sets("skeleton", "parents", value="012"),
        "joints without end": _sets("skeleton", "parents", value=[-1, *range(100_000)]),
        "no joints": _sets("skeleton", value={"names": [], "parents": [], "joints_rest": torch.zeros(0, 3),
                                               "canonical_pose": torch.zeros(0, 3)}),
        "all joints idle": _sets("skeleton", "idle", value=[0, 1, 2]),
        "idle beyond": _sets("skeleton", "idle", value=[7]),
        "joints NaN": _sets("skeleton", "joints_rest", value=torch.full((3, 3), torch.nan)),
        "joints far away": _sets("skeleton", "joints_rest", value=torch.full((3, 3), 1e30)),
        "pose infinite": _sets("skeleton", "canonical_pose", value=torch.full((3, 3), torch.inf)),
        "joints whole numbers": _sets("skeleton", "joints_rest", value=torch.zeros(3, 3, dtype=torch.long)),
        "grid NaN": _sets("grid", "lower", value=torch.full((3,), torch.nan)),
        "grid inside out": _sets("grid", "lower", value=torch.full((3,), 5.0)),
        "grid of 20 km": _sets("grid", "upper", value=torch.full((3,), 2e4)),
        "grid of another shape": _sets("grid", "upper", value=torch.zeros(2, 3)),
        "grid a text": _sets("grid", value=_SECRET),
    }  # fmt: skip
    return found


def _nested(levels: int) -> Any:
    value: Any = 0
    for _ in range(levels):
        value = [value]
    return value


def _doubled(times: int) -> Any:
    value: Any = "x" * 100
    for _ in range(times):
        value = [value, value]
    return value


def _circular() -> Any:
    value: list[Any] = []
    value.append({"again": value})
    return value


def _tensors() -> dict[str, Callable[[dict[str, Any]], object]]:
    """Return states whose tensors are NaN, missing, of another type or layout, or far larger than their storage."""
    weight, owner = "shape.layers.1.weight", "deformer.field.prior.owner"
    like = _content()["state"][weight]
    values = {
        "NaN": torch.full_like(like, torch.nan), "infinite": torch.full_like(like, torch.inf), "huge": like * 1e38,
        "of doubles": like.double(), "of halves": like.half(), "of bfloat16": like.bfloat16(), "complex": like.cfloat(),
        "sparse": like.to_sparse(), "without memory": torch.empty(like.shape, device="meta"), "of bool": like > 0,
        "of another shape": like.T.contiguous(), "empty": torch.zeros(0), "of one number": torch.tensor(1.0),
        "expanded to a terabyte": torch.zeros(1).expand(10**6, 10**6), "a list": like.tolist(), "a text": "x", "none": None,
        "a parameter": torch.nn.Parameter(like),
    }  # fmt: skip
    found: dict[str, Callable[[dict[str, Any]], object]] = {
        f"a weight {name}": _sets("state", weight, value=value) for name, value in values.items()
    }
    found |= {
        "a weight missing": _drops("state", weight),
        "a weight too many": _sets("state", "shape.layers.9.weight", value=like),
        "a weight with a wild name": _sets("state", "\x1b[2J\n" + "x" * 5000, value=like),
        "state a list": _sets("state", value=[like]),
        "state empty": _sets("state", value={}),
        "owners beyond": _sets("state", owner, value=torch.tensor([7, 8, 9])),
        "owners negative": _sets("state", owner, value=torch.tensor([-1, -2**62, 0])),
        "no active cell": _sets("state", "deformer.active_cells", value=torch.zeros(3, 5, 4, dtype=torch.bool)),
        "another box": _sets("state", "deformer.upper", value=torch.full((3,), 1e4)),
    }  # fmt: skip
    return found


def _archives() -> dict[str, bytes]:
    """Return archives that are compressed, cut off, overlapping, encrypted, empty or something else."""
    good = saved(_content())
    bomb = io.BytesIO()
    with zipfile.ZipFile(bomb, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a/data.pkl", b"\x80\x02]" + b"K\x01a" * 10 + b".")
        archive.writestr("a/data/0", bytes(2**26))
    deflated = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(good)) as old, zipfile.ZipFile(deflated, "w", zipfile.ZIP_DEFLATED) as new:
        for member in old.infolist():
            new.writestr(member.filename, old.read(member))
    old_format = io.BytesIO()
    torch.save(_content(), old_format, _use_new_zipfile_serialization=False)
    at = good.index(b"PK\x01\x02")
    return {
        "archive deflated": deflated.getvalue(),
        "archive bomb": bomb.getvalue(),
        "archive cut in half": good[: len(good) // 2],
        "archive without its end": good[:-30],
        "archive without its start": good[3000:],
        "archive encrypted": good[: at + 8] + b"\x01\x00" + good[at + 10 :],
        "archive with an enormous member": good[: at + 20] + struct.pack("<II", 2**31, 2**31) + good[at + 28 :],
        "archive whose members overlap": good.replace(b"archive/data/1", b"archive/data/0"),
        "archive without content": rezipped(good, lambda name, data: None if name.endswith("data.pkl") else data),
        "archive of empty storages": rezipped(good, lambda name, data: b"" if "/data/" in name else data),
        "archive of another byte order": rezipped(good, lambda name, data: b"big" if "byteorder" in name else data),
        "archive with a name that climbs": rezipped(good, lambda name, data: data).replace(b"archive/", b"../../x/"),
        "old format": old_format.getvalue(),
        "empty file": b"",
        "zeros": bytes(4096),
        "text": b"not an avatar",
        "page": b"<html><script>alert(1)</script></html>",
        "safetensors": struct.pack("<Q", 2**60) + b"{}",
        "empty archive": b"PK\x05\x06" + bytes(18),
    }  # fmt: skip


class _Calls:
    """Pickles to a call of a function by its name."""

    def __init__(self, module: str, name: str, *args: Any) -> None:
        self.module, self.name, self.args = module, name, args

    def pickled(self) -> bytes:
        args = pickle.dumps(self.args, 2)[2:-1]
        return (
            b"\x80\x02}(X\x06\x00\x00\x00format"
            + b"X\x0c\x00\x00\x00snarf-avatarX\x01\x00\x00\x00xc"
            + (f"{self.module}\n{self.name}\n".encode() + args + b"Ru.")
        )


def _pickles() -> dict[str, bytes]:
    """Return files whose pickle calls something, in an archive of PyTorch or alone."""
    calls = (
        ("os", "system", "echo ${" + SECRET_NAME + "}"), ("posix", "system", "id"), ("builtins", "eval", "1"),
        ("builtins", "exec", "import os"), ("builtins", "getattr", 1, "x"), ("subprocess", "Popen", ["id"]),
        ("torch", "load", "/etc/passwd"), ("torch.storage", "_load_from_bytes", b"\x80\x02N."), ("torch.hub", "load", "x", "y"),
        ("importlib", "import_module", "antigravity"), ("functools", "partial", print), ("operator", "attrgetter", "x"),
        ("pathlib", "Path", "/etc/passwd"), ("numpy", "load", "/etc/passwd"), ("torch._utils", "_rebuild_parameter", 1, 2, 3),
        ("torch.serialization", "_get_restore_location", "cpu"), ("snarfcli.errors", "UserError", "\x1b[2J"),
        ("collections", "Counter", {}), ("omegaconf", "OmegaConf", 1), ("webbrowser", "open", "http://localhost"),
    )  # fmt: skip
    found = {}
    for module, name, *args in calls:
        call = _Calls(module, name, *args).pickled()
        found[f"calls {module}.{name}"] = rezipped(
            saved(_content()), lambda member, data, call=call: call if member.endswith("data.pkl") else data
        )
    for name, pickled in (
        ("lists nested 5,000 levels", b"]" * 5000 + b"a" * 4999), ("a text of four gigabytes", b"X\xff\xff\xff\xffx"),
        ("a million empty lists", b"(" + b"]" * 10**6 + b"l"), ("a list of itself", b"]q\x00h\x00a"),
    ):  # fmt: skip
        found[name] = rezipped(
            saved(_content()), lambda member, data, new=pickled: b"\x80\x02" + new + b"." if "data.pkl" in member else data
        )
    found["pickle alone"] = _Calls("os", "system", "id").pickled()
    return found


def _places() -> dict[str, Callable[[Path], object]]:
    """Return things that are no file."""

    def good(folder: Path) -> None:
        (folder / "real.pt").write_bytes(saved(_content()))
        (folder / "avatar.pt").symlink_to("real.pt")

    return {
        "symlink to a good file": good,
        "symlink to itself": lambda folder: (folder / "avatar.pt").symlink_to("avatar.pt"),
        "symlink to nothing": lambda folder: (folder / "avatar.pt").symlink_to("missing.pt"),
        "symlink to zeros without end": lambda folder: (folder / "avatar.pt").symlink_to("/dev/zero"),
        "symlink to passwords": lambda folder: (folder / "avatar.pt").symlink_to("/etc/passwd"),
        "pipe": lambda folder: os.mkfifo(folder / "avatar.pt"),
        "folder": lambda folder: (folder / "avatar.pt").mkdir(),
        "nothing": lambda folder: None,
    }


def _systems() -> dict[str, Callable[[Path], object]]:
    """Return what only some systems have."""
    return {
        "template missing": _changed(_sets("template", value=None), "smpl_nn"),
        "template NaN": _changed(_sets("template", "vertices", value=torch.full((20, 3), torch.nan)), "smpl_nn"),
        "template of other joints": _changed(_sets("template", "weights", value=torch.zeros(20, 9)), "smpl_nn"),
        "template empty": _changed(_sets("template", "vertices", value=torch.zeros(0, 3)), "smpl_nn"),
        "parts huge": _changed(_sets("config", "model", "part_width", value=10**6), "nasa"),
        "rows beyond the table": _changed(_sets("state", "shape.grids.table", value=torch.zeros(1, 2)), "grids"),
        "rows negative": _changed(lambda c: c["state"]["shape.grids.rows"].fill_(-9), "grids"),
        "preset weights of another grid": _changed(_sets("config", "skinning", "resolution", value=[9, 9, 9]), "preset"),
        "start bones beyond": _changed(_sets("config", "search", "init_bones", value=[0, 7]), "snarf"),
        "reach infinite": _changed(_sets("state", "reach", value=torch.tensor(torch.inf)), "back_d"),
        "reach of 1e30 m": _changed(_sets("state", "reach", value=torch.tensor(1e30)), "back_d"),
    }


def hostile_records() -> dict[str, bytes]:
    """Return JSON files that a hostile author would put into a run folder."""
    return {
        "settings interpolated": b'{"settings": {"surface": "' + _SECRET.encode() + b'"}}',
        "settings escape": b'{"settings": {"surface": "\\u001b[2J\\u202e\\n"}}',
        "settings of a megabyte": b'{"settings": {"surface": "' + b"x" * 2**20 + b'"}}',
        "settings a list": b'{"settings": [1]}',
        "settings twice": b'{"settings": {"surface": 1}, "settings": {"surface": 2}}',
        "a number of 400 digits": b'{"settings": {"surface": ' + b"9" * 400 + b"}}",
        "a number of 9,000 digits": b'{"settings": {"surface": ' + b"9" * 9000 + b"}}",
        "not a number": b'{"settings": {"surface": NaN}}',
        "infinite": b'{"settings": {"surface": 1e999}}',
        "nested deeply": b'{"settings": ' + b"[" * 100_000,
        "half a surrogate pair": b'{"settings": {"\\ud800": 1, "surface": "\\udfff"}}',
        "no text": b"\xff\xfe\x00",
        "nothing": b"",
        "a list": b"[]",
    }
