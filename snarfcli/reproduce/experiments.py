"""The experiments of the papers: their systems, settings and data."""

from __future__ import annotations

from dataclasses import dataclass, field

__all__ = ["EXPERIMENTS", "Experiment", "Row"]


@dataclass(frozen=True)
class Row:
    """One system of a table."""

    key: str
    """Name in `systems=`, and first part of the names of its runs. One key always means the same overrides."""
    label: str
    """Name in the table."""
    overrides: tuple[str, ...] = ()
    """Settings of `snarf train`."""
    light: tuple[str, ...] = ()
    """Further settings with every preset except paper: the papers' systems keep networks, in a size for minutes."""
    paper: str | None = None
    """Name in `papers.yaml` if the papers report it."""
    inside_test: str = "winding"
    """Labels of the training samples; the evaluation samples are always labelled by winding number."""
    training: str | None = None
    """Training preset of this row; None for the one that is chosen for the experiment."""
    minutes: float | None = None
    """Budget of the training in minutes of one core, from which its number of steps follows; None: the steps of the preset."""
    is_optional: bool = False
    """Whether the row is only in the table if `systems=` names it."""
    note: str = ""
    """Note for the reader of a report with this row."""
    cost: float = 2.0
    """Rough processor time of one run with training=quick, minutes: orders the runs before anything is measured."""

    def settings(self, training: str) -> tuple[str, ...]:
        """Return the settings of `snarf train` with one of its training presets."""
        return self.overrides if training == "paper" else (*self.overrides, *self.light)


@dataclass(frozen=True)
class Experiment:
    """One table with its figures."""

    name: str
    """Name in `snarf reproduce`."""
    title: str
    """Heading of the report."""
    rows: tuple[Row, ...]
    """Systems, in the order of the table."""
    data: tuple[str, ...]
    """Data sets that it can use; the first is the default."""
    subjects: dict[str, tuple[str, ...]] = field(default_factory=dict)
    """Default subjects by data set."""
    training: str = "quick"
    """Default training preset."""
    order: tuple[str, ...] = ()
    """Keys of rows from the best to the worst out of distribution, as the papers report."""
    notes: tuple[str, ...] = ()
    """Notes for the reader of the report; those of its rows follow."""


_DFAUST = ("50002", "50004", "50007", "50009", "50020", "50021", "50022", "50025", "50026", "50027")
_BODIES = ("builtin", "dfaust")
_BODY_SUBJECTS = {"builtin": ("50002", "50004"), "dfaust": _DFAUST}

# The papers' systems use the whole pose, independent of the default of `condition`.
_PAPERS = ("condition=global",)
_BROYDEN = ("model=fast_snarf", "search=broyden", "search.jacobian=broyden", *_PAPERS)
_OURS = ("model=fast_snarf", "search=complete")

# The presets have feature grids, weights at nodes and a loss for made-up poses, which are ours; the papers' systems have
# networks and no such loss.
_NETWORKS = ("shape=small", "skinning=coarse", "training.agreement_weight=0.0")

_POSE_ONET = Row("pose_onet", "Pose-ONet", ("model=pose_onet", *_PAPERS), _NETWORKS, "pose_onet", cost=3.2)
_BACK_D = Row("back_d", "Back-D", ("model=back_d", *_PAPERS), _NETWORKS, "back_d", cost=4.0)
# In the papers its weights have no prior; our presets start from the distances to the bones, which makes another system.
_NO_PRIOR = "skinning.prior_falloff_m=null"
_BACK_LBS = Row(
    "back_lbs", "Back-LBS", ("model=back_lbs", _NO_PRIOR, *_PAPERS), _NETWORKS, "back_lbs", cost=3.6,
    note="Back-LBS learns its weights without a prior, as in the papers.",
)  # fmt: skip
_BACK_LBS_PRIOR = Row(
    "back_lbs-prior", "Back-LBS, weights start from the bones", ("model=back_lbs", *_PAPERS), _NETWORKS, cost=4.0,
    note="Back-LBS, weights start from the bones: from the distances to the posed bones, as ours start from the distances to "
    "the canonical bones.",
)  # fmt: skip
_NASA = Row("nasa", "NASA", ("model=nasa", *_PAPERS), _NETWORKS, "nasa", cost=7.5)
# A step of the presets takes 12 s on one core, 150 times as long as for Fast-SNARF. With nine start bones (as in the released
# code) and an eighth of the points it takes 0.4 s.
_SNARF_LIGHT = (
    *_NETWORKS, "search=broyden", "training.poses_per_step=2", "training.uniform_points=150", "training.surface_points=450",
    "training.far_points=50", "training.validate_every=600",
)  # fmt: skip
_SNARF = Row(
    "snarf", "SNARF", ("model=snarf", *_PAPERS), _SNARF_LIGHT, "snarf", cost=24.0,
    note="With all presets except paper, SNARF searches from nine bones and uses an eighth of the points per step; the times "
    "of its row are for these settings.",
)  # fmt: skip
# As near to its own settings as an hour of one core allows with the 1,200 steps of training=quick, 2.7 s each: its search from
# all 24 bones with at most 20 steps (conf/search/snarf.yaml), and 3,040 instead of 18,000 points, from 4 instead of 8 poses.
_SNARF_HOUR = Row(
    "snarf-hour", "SNARF, search from all bones", ("model=snarf", *_PAPERS),
    (*_NETWORKS, "search=snarf", "training.poses_per_step=4", "training.uniform_points=180", "training.surface_points=540",
     "training.far_points=40"), "snarf", cost=54.0, is_optional=True,
    note="SNARF, search from all bones: as near to its own settings as an hour of one core allows with training=quick, with a "
    "sixth of its points per step, from half as many poses.",
)  # fmt: skip
_NETWORKS_COST = 4.6  # of our kind of search with networks
_FAST_SNARF = Row(
    "fast_snarf-broyden", "Fast-SNARF", _BROYDEN, _NETWORKS, "fast_snarf", cost=_NETWORKS_COST,
    note="Fast-SNARF uses the paper's search (nine bones, Broyden's Jacobian).",
)  # fmt: skip
_GLOBAL = Row("ours-global", "ours, condition=global", (*_OURS, "condition=global"))
_LOCAL = Row("ours-local", "ours, condition=local", (*_OURS, "condition=local"))
_NONE = Row("ours-none", "ours, condition=none", (*_OURS, "condition=none"))


def _grid(key: str, resolution: tuple[int, int, int], paper: str) -> Row:
    sides = ",".join(map(str, resolution))
    overrides = (*_BROYDEN, f"skinning.resolution=[{sides}]")
    return Row(key, " x ".join(map(str, resolution)), overrides, _NETWORKS, paper, cost=_NETWORKS_COST)


def _changed(key: str, label: str, *overrides: str, inside_test: str = "winding", cost: float = 2.0) -> Row:
    """Return a row that differs from `_GLOBAL` in one setting."""
    return Row(key, label, (*_OURS, "condition=global", *overrides), inside_test=inside_test, cost=cost)


_TABLE1 = Experiment(
    "table1",
    "Minimally clothed humans (SNARF Table 1, Fast-SNARF Table 1)",
    (_POSE_ONET, _BACK_D, _BACK_LBS, _BACK_LBS_PRIOR, _NASA, _SNARF, _SNARF_HOUR, _FAST_SNARF, _GLOBAL, _LOCAL),
    _BODIES,
    _BODY_SUBJECTS,
    order=("ours-local", "ours-global", "fast_snarf-broyden", "snarf", "nasa", "back_lbs", "back_d", "pose_onet"),
    notes=(
        "The papers' systems have networks (shape=small skinning=coarse) with every preset except paper; ours have what the "
        "preset says: feature grids and weights at the nodes in quick and standard.",
    ),
)

_TABLE2 = Experiment(
    "table2",
    "Learning strategies and grids of the skinning weights (Fast-SNARF Table 2)",
    (
        _SNARF,
        Row("fast_snarf-broyden", "Fast-SNARF, grid of the preset's network", _BROYDEN, _NETWORKS, "fast_snarf",
            cost=_NETWORKS_COST),
        Row("voxel", "w/o MLP distillation, 64 x 64 x 16",
            (*_BROYDEN, "skinning=voxel", "skinning.symmetric=false", "skinning.resolution=[64,64,16]"),
            ("shape=small", "training.agreement_weight=0.0", "training.extend_weights_every=0"), "voxel", cost=_NETWORKS_COST),
        _grid("grid16", (16, 16, 4), "grid16"),
        _grid("grid32", (32, 32, 8), "grid32"),
        _grid("grid64", (64, 64, 16), "grid64"),
        _grid("grid128", (128, 128, 32), "grid128"),
    ),
    _BODIES,
    _BODY_SUBJECTS,
    notes=("All search from nine bones by Broyden's method, as in the paper.",),
)  # fmt: skip

_RECIPE = (
    "model.blend=probability", "model.blend_sharpness=5", "training.uniform_points=267", "training.surface_points=2133",
    "training.far_points=0", "training.learning_rate=1.0e-3", "training.final_learning_rate=1.0", "training.average_decay=0.0",
    "training.bone_occupancy_weight=1.0", "skinning.prior_falloff_m=null", "skinning.sharpness=20", "shape.prior_radius_m=null",
    "shape.geometric_init=true",
)  # fmt: skip

_ABLATIONS = Experiment(
    "ablations",
    "Ablations: one change at a time",
    (
        Row("ours-global", "base: complete search, exact Jacobian, condition=global", _GLOBAL.overrides),
        Row("broyden9", "search from 9 bones, exact Jacobian",
            ("model=fast_snarf", "search=broyden", "search.jacobian=exact", *_PAPERS)),
        Row("broyden9_approximate", "search from 9 bones, Broyden's Jacobian", _BROYDEN),
        Row("broyden24", "search from all bones, exact Jacobian",
            ("model=fast_snarf", "search=broyden", "search.init_bones=null", "search.jacobian=exact", *_PAPERS)),
        _changed("shape_network", "a network alone for the shape (shape=small)", "shape=small", cost=4.0),
        _changed("weight_network", "a network for the skinning weights (skinning=coarse)", "skinning=coarse", cost=4.0),
        _changed("oriented", "orientation-preserving roots only", "search.orientation_preserving=true"),
        _changed("no_agreement", "no loss for made-up poses", "training.agreement_weight=0.0"),
        _changed("all_cells", "every cell active", "skinning.bone_radius_m=null", "training.refresh_cells_every=0"),
        _changed("parity", "labels by ray parity", inside_test="parity"),
        _LOCAL,
        _changed("global_early", "condition=global, entering where local's does", "condition.layer=2", "condition.size=16"),
        _NONE,
        _changed("target_parent", "joint target: parent (F)", "training.joint_target=parent"),
        _changed("target_own", "joint target: own (released code)", "training.joint_target=own"),
        Row("papers_recipe", "the papers' recipe in small networks", (*_BROYDEN, *_RECIPE), _NETWORKS, cost=_NETWORKS_COST),
    ),
    _BODIES,
    _BODY_SUBJECTS,
    notes=(
        "Every row differs from the base only in what its label says; the papers' recipe changes search, sampling, blend, "
        "learning rate and initialisation together.",
        "All rows are evaluated on labels by winding number.",
    ),
)  # fmt: skip

_MINUTES_OF_TWO_CORES = (2, 5, 20)
# With our start: weights by the distances to the bones, as skinning=coarse has them, and a shape of capsules.
_PAPERS_NETWORKS = (
    "shape=mlp", "shape.prior_radius_m=0.07", "shape.geometric_init=false",
    "skinning=distilled", "skinning.prior_falloff_m=0.01", "skinning.sharpness=5",
)  # fmt: skip


def _timed(key: str, label: str, *overrides: str, training: str | None = None) -> tuple[Row, ...]:
    """Return rows that differ in their budget of minutes alone."""
    return tuple(
        Row(f"{key}-{minutes}", f"{label}, {minutes} min", overrides, training=training, minutes=2.0 * minutes)
        for minutes in _MINUTES_OF_TWO_CORES
    )


_MINUTES = Experiment(
    "minutes",
    "The papers' recipe and ours at equal minutes",
    (
        *_timed("papers_recipe", "the papers' recipe and networks", *_BROYDEN, training="paper"),
        *_timed("ours_networks", "ours with the papers' networks", *_OURS, "condition=local", *_PAPERS_NETWORKS),
        *_timed("ours", "ours", *_OURS, "condition=local"),
    ),
    _BODIES,
    _BODY_SUBJECTS,
    notes=(
        "Minutes are those of two cores, counted as processor time: 2 min are 4 minutes of one core. Every training has one "
        "thread, so other work on the machine hardly changes the result. Loading, validation and evaluation do not count.",
        "A training takes as many steps as fit: a short training with the same settings measures the time of a step first, "
        "without its first steps, in about a tenth of the minutes and at most 120 steps. *core min* is the processor time that "
        "the training then took. On a GPU the wall time counts instead.",
        "The papers' recipe is training=paper search=broyden search.jacobian=broyden: their networks (shape=mlp "
        "skinning=distilled), search from nine bones, blend, sampling, start, losses and constant learning rate.",
        "Ours with the papers' networks has our search, sampling, start, losses, learning rates and condition=local. Ours is "
        "the preset as it is, with feature grids and weights at the nodes.",
    ),
)

_RIGID_NOTE = (
    "Piecewise (rigid): rigid parts cannot follow this stick. With inverse distances to the bones as weights, a bend moves a "
    "point sideways by its distance from the axis times the sine of the angle, however far from the joint. The best rigid "
    "parts, found without a network, are about as good as the trained ones; with inverse squared distances, rigid parts are "
    "much better (benchmarks/bm_rigid_pieces.py)."
)
# S Sec. 4.3: "we do not use local pose-conditioning as the shape does not locally deform with pose". Pose-ONet and the weights
# of Back-LBS depend on the pose nevertheless.
_STICK2D = Experiment(
    "stick2d",
    "2D stick (SNARF Sec. 4.3, Fig. 4 and 5)",
    (
        Row("ours-none", "forward skinning (ours)", (*_OURS, "condition=none"), cost=0.8),
        Row("back_lbs", "Back-LBS", ("model=back_lbs", "condition=none"), cost=0.5),
        Row("pose_onet", "Pose-ONet", ("model=pose_onet", "condition=none"), cost=0.2),
        Row("piecewise", "Piecewise (rigid)", ("model=piecewise", "condition=none"), cost=0.5, note=_RIGID_NOTE),
        Row("piecewise-deforming", "Piecewise (deforming)", ("model=nasa", "condition=none"), cost=0.5),
    ),
    ("stick2d",),
    {"stick2d": ("stick", "stick_object", "stick_step10", "stick_step20", "stick_step30", "stick_step60")},
    training="stick2d",
    order=("ours-none", "back_lbs", "pose_onet"),
    notes=(
        "stick: two bones; stick_object: two bones, a rigid object; stick_stepN: two bones, training angles N degrees apart.",
        "In distribution: angles as in training; out of distribution: larger angles.",
        "The paper's text gives no numbers for Piecewise. It says piecewise rigid, but also a variant of NASA, whose parts "
        "deform with the pose: both are here.",
    ),
)

_CLOTHED_SETTINGS = ("experiment=cape",)
_CLOTHED = Experiment(
    "clothed",
    "Clothed humans (SNARF Sec. 4.5, Fast-SNARF Sec. 5.2)",
    tuple(
        Row(row.key, row.label, (*_CLOTHED_SETTINGS, *row.overrides), row.light, cost=row.cost, note=row.note)
        for row in (Row("smpl_nn", "SMPL NN", ("model=smpl_nn", *_PAPERS)), _SNARF, _FAST_SNARF, _GLOBAL, _LOCAL)
    ),
    ("clothed", "cape"),
    {"clothed": ("50002", "50004")},
    notes=("The papers show pictures of this experiment, but no numbers.",),
)

EXPERIMENTS = {experiment.name: experiment for experiment in (_TABLE1, _TABLE2, _ABLATIONS, _MINUTES, _STICK2D, _CLOTHED)}
"""All experiments by name."""
