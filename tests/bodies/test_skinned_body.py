"""Bodies of any kind: files, our bodies, objects and mappings with the usual names, and what does not fit."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import scipy.sparse
import torch
from smpl_files import octahedron, smpl, toy, write_npz, write_pickle

from snarfcli.bodies import SMPL_JOINT_NAMES, SMPLX_JOINT_NAMES, builtin_body
from snarfcli.bodies.skinned_body import as_skinned_body
from snarfcli.errors import UserError


def arrays() -> dict[str, Any]:
    """Two bones along y, with joints as positions."""
    body = octahedron()
    joints = [[0.0, -0.5, 0.0], [0.0, 0.5, 0.0]]
    return {"vertices": body["v_template"], "weights": body["weights"], "joints": joints, "parents": [-1, 0]}


def test_every_kind_of_smpl_body_is_the_same(tmp_path):
    body, content = builtin_body(torch.float64), smpl()
    betas = [0.5, -1.0]
    wanted = as_skinned_body(body, betas)
    assert wanted.skeleton.names == SMPL_JOINT_NAMES
    torch.testing.assert_close(wanted.vertices, body.shaped(torch.tensor(betas))[0])
    model = SimpleNamespace(  # as a model of the package smplx
        v_template=torch.nn.Parameter(body.v_template),
        lbs_weights=body.weights,
        J_regressor=body.joint_regressor,
        parents=torch.tensor(body.parents),
        shapedirs=body.shapedirs,
    )
    dense = {**content, "J_regressor": content["J_regressor"].toarray()}
    for other, tolerance in (
        (model, 1e-12),
        (content, 1e-12),
        (dense, 1e-12),
        (write_pickle(tmp_path / "a.pkl", content), 1e-6),
    ):
        read = as_skinned_body(other, betas)
        assert (read.skeleton.names, read.skeleton.parents) == (wanted.skeleton.names, wanted.skeleton.parents)
        for one, two in (
            (read.vertices, wanted.vertices),
            (read.weights, wanted.weights),
            (read.skeleton.joints_rest, wanted.skeleton.joints_rest),
            (read.skeleton.canonical_pose, wanted.skeleton.canonical_pose),
        ):
            assert not one.requires_grad
            torch.testing.assert_close(one.double(), two, atol=tolerance, rtol=0)


def test_names_and_canonical_pose_of_other_bodies(tmp_path):
    plain = as_skinned_body(arrays())
    assert plain.skeleton.names == ("joint_0", "joint_1")
    assert not plain.skeleton.canonical_pose.any()
    assert plain.vertices.dtype == torch.float32
    named = as_skinned_body({**arrays(), "joint_names": ["pelvis", "l_hip"]})
    assert named.skeleton.canonical_pose[1].tolist() == pytest.approx([0, 0, torch.pi / 6])
    animal = toy(24, 2)  # as many joints as SMPL, in another tree
    content = {"vertices": animal["v_template"], **{key: animal[key] for key in ("weights", "J_regressor", "kintree_table")}}
    assert as_skinned_body(content).skeleton.names[1] == "joint_1"
    smplx = toy(55, 2)
    smplx["kintree_table"][0, :22] = builtin_body().parents[:22]
    del smplx["f"]
    assert as_skinned_body(smplx).skeleton.names == SMPLX_JOINT_NAMES
    assert as_skinned_body(str(write_npz(tmp_path / "a.npz", octahedron()))).skeleton.num_joints == 2


@pytest.mark.parametrize("root", [-1, None, 0, 2**32 - 1, 2**64 - 1])
def test_roots_as_programs_write_them(root):
    assert as_skinned_body({**arrays(), "parents": [root, 0]}).skeleton.parents == (-1, 0)


def test_weights_are_normalised():
    weights = torch.tensor(octahedron()["weights"]) * 1.004
    assert as_skinned_body({**arrays(), "weights": weights}).weights.sum(1).tolist() == pytest.approx([1] * 6, abs=1e-7)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"weights": None, "parents": None}, r"body: wanted vertices \[V, 3\], .*, got a dict without weights, parents"),
        ({"vertices": np.zeros((6, 2))}, r"vertices: wanted shape \[V, 3\], at least one, got \[6, 2\]"),
        ({"vertices": np.zeros((0, 3))}, r"vertices: wanted shape \[V, 3\], at least one, got \[0, 3\]"),
        ({"vertices": "a path"}, "vertices: wanted an array of numbers, got a str"),
        ({"vertices": np.full((6, 3), np.nan)}, "vertices: wanted finite numbers"),
        ({"weights": np.ones((5, 2)) / 2}, r"weights: wanted shape \[6, J\], one row per vertex, got \[5, 2\]"),
        (
            {"weights": np.ones((6, 2))},
            "weights: wanted 0 or more and a sum of 1 per vertex, got 1 or more and sums from 2",
        ),
        ({"weights": np.tile([1.5, -0.5], (6, 1))}, "weights: wanted 0 or more and a sum of 1 per vertex, got -0.5 or more"),
        ({"joints": np.zeros((3, 3))}, r"joints: wanted shape \[2, 3\], one per column of weights, got \[3, 3\]"),
        ({"parents": [-1, 0, 1]}, "parents: wanted 2, one per column of weights, got 3"),
        ({"parents": 3}, "parents: wanted 2 whole numbers, got a int of others"),
        ({"parents": ["root", "hip"]}, "parents: wanted 2 whole numbers, got a list of others"),
        ({"parents": [1, -1]}, r"parents: wanted -1 for the root and each parent before its children, got \[1, -1\]"),
        ({"parents": [-1, 0.5]}, r"parents: wanted -1 for the root and each parent before its children, got \[-1, 0.5\]"),
        ({"joint_names": ["a"]}, "joint_names: wanted 2, got 1"),
    ],
)
def test_what_does_not_fit_is_named(change, message):
    with pytest.raises(ValueError, match=message) as caught:
        as_skinned_body({**arrays(), **change})
    assert "\n" not in str(caught.value)


def test_betas_that_do_not_fit():
    with pytest.raises(ValueError, match="betas: wanted none for a body without shapedirs"):
        as_skinned_body(arrays(), [1.0])
    with pytest.raises(ValueError, match=r"betas: wanted at most as many as shapedirs \[6, 3, 2\] has, got \[3\]"):
        as_skinned_body(octahedron(), [1.0, 2.0, 3.0])
    with pytest.raises(ValueError, match="betas: wanted at most 10 values"):
        as_skinned_body(builtin_body(), [0.0] * 11)


def test_other_things_are_no_body(tmp_path):
    with pytest.raises(UserError, match="no body at"):
        as_skinned_body(tmp_path / "none.npz")
    with pytest.raises(ValueError, match="got a NoneType without vertices, weights, joints, parents"):
        as_skinned_body(None)
    ragged = {**arrays(), "joints": [[0.0, 0.0, 0.0], [0.0]]}
    with pytest.raises(ValueError, match="joints: wanted an array of numbers, got a list"):
        as_skinned_body(ragged)


def test_a_sparse_regressor_of_a_loaded_file():
    content = octahedron()
    sparse = as_skinned_body({**content, "J_regressor": scipy.sparse.csr_matrix(content["J_regressor"])})
    torch.testing.assert_close(sparse.skeleton.joints_rest, as_skinned_body(content).skeleton.joints_rest)
