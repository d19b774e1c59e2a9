"""Makes `python2_body_*.pkl` with the libraries that wrote SMPL's files: Python 2.7, NumPy 1.16.6, SciPy 1.2.3, chumpy 0.70.

    python2.7 make_python2_body.py

The body is made up here: two bones along y, and an octahedron around them.
"""

import os
from collections import OrderedDict

import chumpy
import cPickle
import numpy as np
import scipy.sparse


def main():
    folder = os.path.dirname(os.path.abspath(__file__))
    vertices = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], "f8")
    upper = (vertices[:, 1] > 0).astype("f8")
    components = chumpy.array(np.arange(6 * 3 * 4).reshape(6, 3, 4) / 100.0)
    assert components.r.shape  # fills the caches, as using the body did before it was saved
    faces = [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]]
    body = {
        "v_template": np.asfortranarray(vertices),
        "f": np.array(faces, "u4"),
        "weights": chumpy.array(np.stack([1 - upper, upper], 1)),
        "J_regressor": scipy.sparse.csc_matrix(np.array([[0, 0, 0, 0.5, 0.25, 0.25], [0.5, 0.5, 0, 0, 0, 0]])),
        "J_regressor_prior": scipy.sparse.csr_matrix(np.eye(2, 6)),
        "kintree_table": np.array([[2**32 - 1, 0], [0, 1]], "u4"),
        "shapedirs": components[:, :, :2],
        "posedirs": (np.arange(6 * 3 * 9).reshape(6, 3, 9) / 1000.0).astype(">f8"),
        "bs_type": "lrotmin",
        "pose_training_info": OrderedDict([("scans", np.float64(3)), ("ids", {1, 2})]),
    }
    for protocol in (0, 1, 2):
        with open(os.path.join(folder, "python2_body_" + str(protocol) + ".pkl"), "wb") as file:
            cPickle.dump(body, file, protocol)


if __name__ == "__main__":
    main()
