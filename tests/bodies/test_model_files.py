"""Body files in all released forms: the same body from each, posed as by an independent implementation; else one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from smpl_files import octahedron, pickled, smpl, toy, write_npz, write_pickle

from snarfcli.bodies import builtin_body, load_body
from snarfcli.errors import UserError

GOLDEN = Path(__file__).parent / "golden"


def posed(body, shapes: int = 10, seed: int = 0):
    rng = np.random.default_rng(seed)
    pose = 0.6 * rng.normal(size=(2, body.num_joints, 3))
    return body.pose(pose, rng.normal(size=min(shapes, body.num_betas)), rng.normal(size=(2, 3))).vertices


def test_smpl_is_the_same_from_every_file(tmp_path):
    expected = posed(builtin_body(torch.float64))
    v1_0, v1_1 = smpl(), smpl(300)
    int64 = {**v1_0, "kintree_table": np.array([[-1, *v1_0["kintree_table"][0, 1:].tolist()], range(24)])}
    files = {
        "v1.0.0": write_pickle(tmp_path / "basicModel_f_lbs_10_207_0_v1.0.0.pkl", v1_0),
        "all chumpy": write_pickle(tmp_path / "all.pkl", v1_0, chumpy=("shapedirs", "weights", "posedirs", "v_template")),
        "no chumpy": write_pickle(tmp_path / "none.PKL", int64, chumpy=()),
        "selected": write_pickle(tmp_path / "selected.pkl", v1_0, selected=10),
        "v1.1.0": write_pickle(tmp_path / "basicmodel_f_lbs_10_207_0_v1.1.0.pkl", v1_1, chumpy=()),
        "npz": write_npz(tmp_path / "SMPL_FEMALE.npz", {**v1_0, "f": v1_0["f"].astype(np.int64)}),
    }
    for name, path in files.items():
        body = load_body(path, dtype=torch.float64)
        assert torch.equal(posed(body), expected), name
        assert body.joint_names[4] == "l_knee", name
        assert body.num_betas == (300 if "1.1" in path.name else 10), name
        assert all(tensor.is_contiguous() for tensor in (body.weights, body.shapedirs, body.posedirs, body.v_template))
    few = load_body(files["v1.1.0"], num_betas=16)
    assert few.num_betas == 16
    assert few.v_template.dtype == torch.float32
    assert few.shapedirs.untyped_storage().nbytes() == 4 * 6890 * 3 * 16
    # float32: metres, 24 transforms chained nine deep
    torch.testing.assert_close(posed(few).double(), expected, atol=3e-6, rtol=0)


@pytest.mark.parametrize("protocol", [0, 1, 2])
def test_files_of_python_2_with_chumpy(protocol, tmp_path):
    upper = np.array([0, 0, 1, 0, 0, 0.0])
    arrays = {
        **octahedron(),
        "weights": np.stack([1 - upper, upper], 1),
        "J_regressor": np.array([[0, 0, 0, 0.5, 0.25, 0.25], [0.5, 0.5, 0, 0, 0, 0]]),
        "shapedirs": (np.arange(72).reshape(6, 3, 4) / 100)[..., :2],
        "posedirs": np.arange(162).reshape(6, 3, 9) / 1000,
    }
    body = load_body(GOLDEN / f"python2_body_{protocol}.pkl", dtype=torch.float64)
    expected = load_body(write_npz(tmp_path / "body.npz", arrays), dtype=torch.float64)
    assert torch.equal(posed(body), posed(expected))
    assert torch.equal(body.faces, expected.faces)


@pytest.mark.parametrize(
    ("joints", "stored", "shapes"),
    [(52, 16, 16), (52, 10, 10), (55, 20, 10), (55, 400, 300), (55, 10, 10), (33, 41, 41), (16, 10, 10), (5, 400, 300)],
)
def test_other_skeletons(joints, stored, shapes, tmp_path):
    arrays = toy(joints, stored)
    body = load_body(write_pickle(tmp_path / "body.pkl", arrays, selected=3), dtype=torch.float64)
    assert body.num_joints == joints
    assert body.num_betas == shapes
    np.testing.assert_array_equal(body.shapedirs, arrays["shapedirs"][..., :shapes])
    assert torch.equal(posed(body), posed(load_body(write_npz(tmp_path / "body.npz", arrays), dtype=torch.float64)))
    names = body.joint_names
    assert len(set(names)) == joints
    if joints == 52:
        assert names[22] == "l_index1"
        assert names[37] == "r_index1"
        assert names[51] == "r_thumb3"
    if joints == 55:
        assert names[22:26] == ("jaw", "l_eye", "r_eye", "l_index1")
        assert names[54] == "r_thumb3"
    if joints in (52, 55):
        sides = body.skeleton().left_right
        assert [sides[sides[joint]] for joint in range(joints)] == list(range(joints))
        assert sides[21] == 20
        assert sum(joint == other for joint, other in enumerate(sides)) == (6 if joints == 52 else 7)
        assert body.skeleton().canonical_pose[1, 2] > 0


def test_names_in_the_file(tmp_path):
    arrays = octahedron()
    for names, expected in [(["hip", "tip"], ("hip", "tip")), (["hip", "hip"], ("joint_0", "joint_1")),
                            (["a\x1b", "b"], ("joint_0", "joint_1")), ([1, 2], ("joint_0", "joint_1"))]:  # fmt: skip
        path = write_npz(tmp_path / "body.npz", {**arrays, "joint_names": np.array(names)})
        assert load_body(path).joint_names == expected


def test_layouts_of_the_pose_correctives(tmp_path):
    arrays = toy(5, 10)
    expected = posed(load_body(write_npz(tmp_path / "body.npz", arrays)))
    for name, layout in {"rows": arrays["posedirs"].reshape(240, 36), "columns": arrays["posedirs"].reshape(240, 36).T}.items():
        body = load_body(write_npz(tmp_path / f"{name}.npz", {**arrays, "posedirs": layout}))
        assert torch.equal(posed(body), expected)
    zeros = load_body(write_npz(tmp_path / "zeros.npz", {**arrays, "posedirs": np.zeros((80, 3, 36))}))
    without = load_body(write_npz(tmp_path / "none.npz", {key: arrays[key] for key in arrays if key != "posedirs"}))
    assert without.posedirs.shape == (80, 3, 0)
    torch.testing.assert_close(posed(without), posed(zeros))
    square = {**toy(5, 10, vertices=12), "posedirs": np.zeros((36, 36))}
    with pytest.raises(UserError, match="ambiguous"):
        load_body(write_npz(tmp_path / "square.npz", square))


def test_bending_two_bones(tmp_path):
    body = load_body(write_npz(tmp_path / "body.npz", octahedron()), dtype=torch.float64)
    assert body.parents == (-1, 0)
    assert body.joint_names == ("joint_0", "joint_1")
    bent = body.pose(torch.tensor([[[0.0, 0, 0], [0, 0, np.pi / 2]]])).vertices[0]
    torch.testing.assert_close(bent[2], torch.tensor([-1.0, 0, 0], dtype=torch.float64))  # +y turns to -x
    torch.testing.assert_close(bent[3], torch.tensor([0.0, -1, 0], dtype=torch.float64))


# --- against the implementation of SMPL's authors -----------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("kind", ["smpl", "smplh", "smplx"])
def test_vertices_agree_with_smplx(kind, dtype, tmp_path):
    lbs = pytest.importorskip("smplx.lbs", reason="smplx is not installed (pip install snarf[test-smplx])").lbs
    arrays = {"smpl": lambda: smpl(10), "smplh": lambda: toy(52, 16, 200), "smplx": lambda: toy(55, 20, 200)}[kind]()
    body = load_body(write_pickle(tmp_path / "body.pkl", arrays), dtype=dtype)
    rng = np.random.default_rng(3)
    pose, betas = (torch.as_tensor(rng.normal(size=size)) for size in ((4, body.num_joints, 3), body.num_betas))
    tensors = {key: torch.as_tensor(value) for key, value in arrays.items() if isinstance(value, np.ndarray)}
    regressor = arrays["J_regressor"]
    vertices, joints = lbs(
        betas.expand(4, -1), pose.reshape(4, -1), tensors["v_template"], tensors["shapedirs"][..., : len(betas)],
        tensors["posedirs"].reshape(-1, tensors["posedirs"].shape[-1]).T,
        torch.as_tensor(regressor.toarray() if hasattr(regressor, "toarray") else regressor),
        torch.tensor(body.parents), tensors["weights"],
    )  # fmt: skip
    ours = body.pose(pose, betas)
    # smplx adds 1e-8 to each rotation vector before it takes its length: measured worst 9e-8 in float64, metres.
    tolerance = 5e-7 if dtype == torch.float64 else 1e-5  # measured worst 1.4e-6
    assert (ours.vertices.double() - vertices).abs().max() < tolerance
    assert (ours.joints.double() - joints).abs().max() < tolerance


def test_files_agree_with_smplx(tmp_path):
    smplx = pytest.importorskip("smplx", reason="smplx is not installed (pip install snarf[test-smplx])")
    path = write_pickle(tmp_path / "smpl" / "SMPL_FEMALE.pkl", smpl(), chumpy=())
    path.write_bytes(path.read_bytes().replace(b"cscipy.sparse.csc\n", b"cscipy.sparse._csc\n"))  # for SciPy 2
    theirs = smplx.create(tmp_path, "smpl", gender="female", batch_size=2, dtype=torch.float64)
    rng = np.random.default_rng(4)
    pose, betas, translation = 0.7 * rng.normal(size=(2, 24, 3)), rng.normal(size=10), rng.normal(size=(2, 3))
    flat = torch.as_tensor(pose.reshape(2, 72))
    output = theirs(
        betas=torch.as_tensor(betas).expand(2, -1), body_pose=flat[:, 3:], global_orient=flat[:, :3],
        transl=torch.as_tensor(translation),
    )  # fmt: skip
    ours = load_body(path, dtype=torch.float64).pose(pose, betas, translation)
    assert (ours.vertices - output.vertices).abs().max() < 1e-7  # see above; measured worst 2e-8
    assert (ours.joints - output.joints[:, :24]).abs().max() < 1e-7


# --- files that are wrong -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"shapedirs": None, "f": None}, "lacks f, shapedirs"),
        ({"weights": np.zeros((5, 2), np.float32)}, r"weights: wanted shape \[6, 2\], got \[5, 2\]"),
        ({"weights": np.zeros(6, np.float32)}, r"weights: wanted shape \[V, J\], got \[6\]"),
        ({"weights": np.full((6, 2), 0.6)}, "weights: wanted rows that sum to 1, got an error of 0.2"),
        ({"posedirs": np.zeros((6, 3, 10), np.float32)}, r"posedirs: wanted shape \[6, 3, 9\], got \[6, 3, 10\]"),
        ({"shapedirs": np.zeros((6, 3))}, r"shapedirs: wanted shape \[6, 3, S\], got \[6, 3\]"),
        ({"v_template": np.full((6, 3), np.nan)}, "v_template: wanted finite numbers"),
        ({"posedirs": np.full((6, 3, 9), 1e300)}, "posedirs: wanted finite numbers"),
        ({"weights": np.array("x")}, "weights: wanted finite numbers"),
        ({"f": np.full((8, 3), 6)}, "vertex indices from 0 to 5"),
        ({"f": np.full((8, 3), -1)}, "vertex indices from 0 to 5"),
        ({"f": np.full((8, 3), 0.5)}, "vertex indices from 0 to 5"),
        ({"f": np.zeros((0, 3), int)}, "vertex indices from 0 to 5"),
        ({"f": np.zeros((8, 4), int)}, r"f: wanted shape \[8, 3\], got \[8, 4\]"),
        ({"kintree_table": np.array([[1, -1], [0, 1]])}, r"wanted -1 \(root\) as parent of joint 0, got 1"),
        ({"kintree_table": np.array([[-1, 1], [0, 1]])}, "parent of joint 1 is 1, which does not come before it"),
        ({"kintree_table": np.array([[-1, 7], [0, 1]])}, "parent of joint 1 is 7, which does not exist"),
        ({"kintree_table": np.array([[-1, np.nan], [0, 1]])}, "wanted indices of joints"),
        ({"v_template": np.array(1.0)}, "v_template: wanted shape"),
    ],
)
def test_broken_files(tmp_path, change, message):
    arrays = {key: value for key, value in {**octahedron(), **change}.items() if value is not None}
    chumpy = tuple(key for key in ("shapedirs", "weights") if key in arrays)
    for path in (write_npz(tmp_path / "body.npz", arrays), write_pickle(tmp_path / "body.pkl", arrays, chumpy=chumpy)):
        with pytest.raises(UserError, match=message) as caught:
            load_body(path)
        assert str(caught.value).startswith(f"body {path}")
        assert str(caught.value).isprintable()


def test_a_cycle_of_joints(tmp_path):
    arrays = toy(5, 10)
    arrays["kintree_table"][0] = [-1, 0, 3, 2, 0]
    with pytest.raises(UserError, match="parent of joint 2 is 3, which does not come before it"):
        load_body(write_npz(tmp_path / "body.npz", arrays))


def test_a_sparse_regressor_of_another_size_is_not_unfolded(tmp_path):
    import scipy.sparse

    for shape in ((2, 2**31 - 1), (2**31 - 1, 6)):
        huge = (scipy.sparse.csr_matrix if shape[0] == 2 else scipy.sparse.csc_matrix)(shape)
        with pytest.raises(UserError, match=r"J_regressor: wanted shape \[2, 6\], got \[.*2147483647.*\]"):
            load_body(write_pickle(tmp_path / "body.pkl", {**octahedron(), "J_regressor": huge}))


def test_missing_and_foreign_files(tmp_path):
    with pytest.raises(UserError, match="no body at"):
        load_body(tmp_path / "none.npz")
    with pytest.raises(UserError, match="no body at"):
        load_body(tmp_path / "none.pkl")
    (tmp_path / "model.pkl").write_bytes(b"x")
    with pytest.raises(UserError, match="is not a pickle"):
        load_body(tmp_path / "model.pkl")
    (tmp_path / "list.pkl").write_bytes(b"]K\x01a.")
    with pytest.raises(UserError, match=r"wanted named arrays \(.*\), got a list"):
        load_body(tmp_path / "list.pkl")
    with pytest.raises(UserError, match=r"wanted an .npz or .pkl file"):
        load_body(tmp_path / "body.obj")
    (tmp_path / "evil.pkl").write_bytes(pickled(octahedron()).replace(b"cchumpy.ch\nCh\n", b"cposix\nsystem\n"))
    with pytest.raises(UserError, match=r"asks for posix.system, which plain data does not need"):
        load_body(tmp_path / "evil.pkl")
    with pytest.raises(ValueError, match="num_betas: wanted at least 0"):
        load_body(tmp_path / "evil.pkl", num_betas=-1)
