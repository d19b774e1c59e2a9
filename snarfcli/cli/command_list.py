"""The subcommands of `snarf`: their modules, flags and examples."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["COMMANDS", "COMMAND_LIST", "Command"]


@dataclass(frozen=True)
class Command:
    """One subcommand."""

    name: str
    """Name of the configuration file, and of the command on the command line."""
    module: str
    """Module below `snarfcli.commands` with `run` and the configuration's dataclass."""
    schema: str
    """Name of that dataclass."""
    summary: str
    """What it does, in one line."""
    example: str
    """A call that works on a fresh machine once the commands before it have run."""
    flags: dict[str, str]
    """Flags and the overrides they stand for; `{}` takes the flag's value, `[{}]` those of all times that it is given."""
    positional: str | None = None
    """Setting whose value may stand first, without its name."""
    lists_of_settings: tuple[str, ...] = ()
    """Settings whose value is a list of settings."""
    folder: str = ""
    """Folder of its configuration below conf/. Outside of it there are groups, whose names its settings may have therefore."""
    is_hidden: bool = False
    """Whether it is only for the program itself."""


COMMAND_LIST = (
    Command(
        "preprocess",
        "preprocess",
        "PreprocessConfig",
        "sample occupancies from posed meshes",
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
        "IoU on the held-out motion, or on out-of-distribution poses (also: evaluate)",
        "snarf eval --ood subject=50002",
        {"--ood": "split=ood"},
    ),
    Command(
        "animate",
        "animate",
        "AnimateConfig",
        "posed meshes and a video of a motion",
        "snarf animate --pose seq.npz subject=50002",
        {"--pose": "pose={}"},
    ),
    Command(
        "export",
        "export",
        "ExportConfig",
        "a rigged, animated character for other programs: glb, fbx, usd, or a mesh a frame",
        "snarf export --pose a.npz --pose b.bvh subject=50002",
        {"--pose": "pose=[{}]"},
    ),
    Command(
        "view",
        "view",
        "ViewConfig",
        "an avatar in the browser: pose it, play motions",
        "snarf view --pose seq.npz subject=50002",
        {"--pose": "pose=[{}]", "--port": "port={}", "--host": "host={}", "--no-open": "open=false"},
    ),
    Command(
        "doctor",
        "doctor",
        "DoctorConfig",
        "versions, what runs natively and what does not, and why",
        "snarf doctor",
        {},
    ),
    Command(
        "reproduce",
        "reproduce",
        "ReproduceConfig",
        "the papers' tables and figures: table1, table2, ablations, stick2d, clothed or all",
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
        "one run of a plan, started by Hydra's launchers",
        "snarf reproduce_job plan=plan.json job=0",
        {},
        folder="reproduce",
        is_hidden=True,
    ),
)
COMMANDS = {command.name: command for command in COMMAND_LIST} | {"evaluate": COMMAND_LIST[2]}
