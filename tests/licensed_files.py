"""Files in the layouts of licensed data sets: the built-in body replaces SMPL's, its motions the recordings."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np

from snarfcli.bodies import builtin_body
from snarfcli.datasets.amass_files import papers_split
from snarfcli.motions import builtin_motion

FRAMES = 4
BETAS = np.linspace(-1, 1.5, 16)
BODY_NAMES = {
    "female": "basicModel_f_lbs_10_207_0_v1.0.0.npz",
    "male": "basicmodel_m_lbs_10_207_0_v1.0.0.npz",
}


def write_body(folder: Path, gender: str = "female") -> Path:
    """Write the built-in body under the name of an SMPL file."""
    body = builtin_body()
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / BODY_NAMES[gender]
    np.savez(
        path,
        v_template=body.v_template.numpy() * (1.0 if gender == "female" else 1.05),
        f=body.faces.numpy().astype(np.uint32),
        weights=body.weights.numpy(),
        J_regressor=body.joint_regressor.numpy(),
        kintree_table=np.array([[2**32 - 1, *body.parents[1:]], range(24)], np.uint32),
        shapedirs=body.shapedirs.numpy(),
        posedirs=body.posedirs.numpy(),
    )
    return path


def amass_poses(name: str, frames: int = FRAMES, dtype: type = np.float64) -> np.ndarray:
    """Return poses [T, 72] of SMPL, radians, random per name; hands straight."""
    motion = builtin_motion("punching", seed=sum(name.encode()), duration_s=frames / 60)
    poses = motion.poses.reshape(frames, 72).astype(dtype)
    poses[:, 66:] = 0
    return poses


def write_old(path: Path, values: np.ndarray, **changes: object) -> None:
    """Write an AMASS file of the older release: SMPL-H, 156 values; fingers curled."""
    wide = np.concatenate([values[:, :66], np.full((len(values), 90), 0.3)], 1)
    content = {
        "trans": np.ones((len(values), 3)), "gender": np.array("female"), "mocap_framerate": np.array(60.0),
        "betas": BETAS, "dmpls": np.zeros((len(values), 8)), "poses": wide,
    } | changes  # fmt: skip
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, **{name: value for name, value in content.items() if value is not None})


def write_new(path: Path, values: np.ndarray, **changes: object) -> None:
    """Write an AMASS file of the newer release: SMPL-X, 165 values; fingers curled, jaw open."""
    wide = np.concatenate([values[:, :66], np.full((len(values), 99), 0.3)], 1)
    content = {
        "gender": np.array(b"female"), "surface_model_type": np.array("smplx"), "mocap_frame_rate": np.array(60.0),
        "mocap_time_length": np.array(1.0), "trans": np.ones((len(values), 3)), "poses": wide, "betas": BETAS,
        "num_betas": np.array(16), "root_orient": wide[:, :3], "pose_body": wide[:, 3:66], "pose_hand": wide[:, 75:],
        "pose_jaw": wide[:, 66:69], "pose_eye": wide[:, 69:75],
    } | changes  # fmt: skip
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, **{name: value for name, value in content.items() if value is not None})


def write_dfaust(root: Path, subject: str = "50002", release: str = "old", nested: str = "", dtype: type = np.float64) -> None:
    """Write one DFaust subject and PosePrior as the archives unpack; `nested` names the folders in between."""
    split = papers_split()
    sequences = split["dfaust"][subject]
    base = root / nested
    for name in sequences["train"] + sequences["test"]:
        poses = amass_poses(name, dtype=dtype)
        if release == "old":
            write_old(base / "DFaust_67" / subject / f"{subject}_{name}_poses.npz", poses)
        else:
            write_new(base / "DFaust" / subject / f"{subject}_{name}_stageii.npz", poses)
    if release == "old":
        np.savez(base / "DFaust_67" / subject / "shape.npz", gender=np.array("female"), betas=BETAS)
    for name in split["poseprior"]["ood"]:
        poses = amass_poses(name, 12, dtype)
        if release == "old":
            write_old(base / "MPI_Limits" / "03099" / f"{name}_poses.npz", poses, gender=np.array("male"))
        else:
            write_new(base / "PosePrior" / "03099" / f"{name}_stageii.npz", poses, gender=np.array("male"))


def write_cape(root: Path, person: str = "00032", outfits: dict[str, tuple[str, ...]] | None = None) -> Path:
    """Write a CAPE release: six frames per sequence, meshes 1 cm off the body; return its folder."""
    body = builtin_body()
    release = root / "cape_release"
    minimal = body.v_template.numpy() * np.float32(0.98)
    folder = release / "minimal_body_shape" / person
    folder.mkdir(parents=True)
    np.save(folder / f"{person}_minimal.npy", minimal.astype(np.float64))
    (release / "misc").mkdir()
    (release / "misc" / "subj_genders.pkl").write_bytes(pickle.dumps({person: "female"}, protocol=2))
    for outfit, names in (outfits or {"longshort": ("hips", "squat", "tilt")}).items():
        for name in names:
            motion = builtin_motion("hips", seed=sum(name.encode()), duration_s=0.1)
            place = release / "sequences" / person / f"{outfit}_{name}"
            place.mkdir(parents=True)
            for frame, (pose, transl) in enumerate(zip(motion.poses, motion.translation + 1.0, strict=True)):
                posed = body.pose(pose[None], None, transl[None]).vertices[0].numpy()
                np.savez(
                    place / f"{outfit}_{name}.{frame + 1:06d}.npz",
                    v_cano=minimal,
                    v_posed=posed.astype(np.float64),
                    pose=pose.reshape(72).astype(np.float32),
                    transl=transl,
                )
    return release
