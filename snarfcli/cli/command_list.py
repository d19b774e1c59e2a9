"""The subcommands of `snarf`: their modules, flags and examples."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["COMMANDS", "COMMAND_LIST", "Command"]


@dataclass(frozen=True)
class Command:
    """One subcommand."""

    name: str
    """Name on the command line, and of the configuration file."""
    module: str
    """Module of `snarfcli.commands` with `run` and the dataclass of the configuration."""
    schema: str
    """Name of that dataclass."""
    summary: str
    """What it does, in one line."""
    example: str
    """A call that works on a new machine after the examples of the previous commands."""
    flags: dict[str, str]
    """Flags and their overrides. `{}` takes the value of the flag, `[{}]` the values of all its occurrences."""
    positional: str | None = None
    """Setting whose value can be given as first argument, without its name."""
    lists_of_settings: tuple[str, ...] = ()
    """Settings whose value is a list of settings."""
    folder: str = ""
    """Folder of its configuration below conf/; needed where a setting has the name of a configuration group."""
    is_hidden: bool = False
    """Whether only the program itself calls it."""


COMMAND_LIST = (
    Command(
        "fit",
        "fit",
        "FitConfig",
        "fit a body to scans without poses: meshes or point clouds of a person",
        "snarf fit data=meshes subject=me",
        {},
    ),
    Command(
        "preprocess",
        "preprocess",
        "PreprocessConfig",
        "sample occupancy points from posed meshes",
        "snarf preprocess subject=50002",
        {},
    ),
    Command(
        "train",
        "train",
        "TrainConfig",
        "train the avatar of one subject",
        "snarf train subject=50002",
        {"--resume": "resume=true"},
    ),
    Command(
        "eval",
        "evaluate",
        "EvalConfig",
        "measure the IoU on held-out motion or on out-of-distribution poses (also: evaluate)",
        "snarf eval --ood subject=50002",
        {"--ood": "split=ood"},
    ),
    Command(
        "animate",
        "animate",
        "AnimateConfig",
        "write the posed meshes and a video of a motion",
        "snarf animate --pose seq.npz subject=50002",
        {"--pose": "pose={}"},
    ),
    Command(
        "export",
        "export",
        "ExportConfig",
        "write a rigged, animated character (glb, html, fbx, usd, vrm), its motion (bvh), one mesh per frame (ply, obj) or "
        "the avatar itself with a model card (pretrained)",
        "snarf export --pose a.npz --pose b.bvh subject=50002",
        {"--pose": "pose=[{}]"},
    ),
    Command(
        "view",
        "view",
        "ViewConfig",
        "show the avatar in the browser: pose it, play motions",
        "snarf view --pose seq.npz subject=50002",
        {"--pose": "pose=[{}]", "--port": "port={}", "--host": "host={}", "--no-open": "open=false"},
    ),
    Command(
        "doctor",
        "doctor",
        "DoctorConfig",
        "check the installation, a data set or a motion file: versions, reasons for fallbacks, what was read",
        "snarf doctor --pose walk.bvh",
        {"--pose": "pose={}"},
    ),
    Command(
        "reproduce",
        "reproduce",
        "ReproduceConfig",
        "make the papers' tables and figures: table1, table2, ablations, minutes, stick2d, clothed or all",
        "snarf reproduce table1 subjects=[50002,50004] training=quick",
        {"--dry-run": "dry_run=true"},
        positional="what",
        lists_of_settings=("extra", "launcher_settings"),
        folder="reproduce",
    ),
    Command(
        "reproduce_job",
        "reproduce_job",
        "ReproduceJobConfig",
        "one run of a plan; called by snarf reproduce",
        "snarf reproduce_job plan=plan.json job=0",
        {},
        folder="reproduce",
        is_hidden=True,
    ),
)
COMMANDS = {command.name: command for command in COMMAND_LIST}
COMMANDS["evaluate"] = COMMANDS["eval"]
