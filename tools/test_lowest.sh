#!/bin/sh
# Install the oldest packages that pyproject.toml allows into build/lowest, with the Python $1, and run the tests that meet them
# most: files, samples, pictures, training, the command line. NumPy is 2.2, since older packages that fail with NumPy 2 would pass
# with NumPy 1. Needs Python 3.10, where the oldest packages have wheels, and downloads 3 GB on Linux (PyTorch's CUDA build).
set -eu
cd "$(dirname "$0")/.."
python=${1:-python3.10}
"$python" -c 'import sys; sys.exit(sys.version_info[:2] != (3, 10))' || {
    echo "the oldest packages have wheels for Python 3.10, and $python is $("$python" --version 2>&1); give PYTHON=python3.10" >&2
    exit 2
}
folder=build/lowest
[ -x $folder/bin/python ] || "$python" -m venv $folder
$folder/bin/python -m pip install --quiet uv
echo 'numpy==2.2.*' >$folder/numpy.txt
$folder/bin/uv pip compile --quiet --resolution lowest-direct --override $folder/numpy.txt --python-version 3.10 \
    --extra commands --output-file $folder/requirements.txt pyproject.toml
$folder/bin/uv pip install --quiet --python $folder/bin/python -r $folder/requirements.txt pytest scikit-build-core ninja cmake
$folder/bin/python -m pip install --quiet --no-deps --no-build-isolation .
$folder/bin/python -m pytest -q tests/formats tests/sampling tests/samples tests/rendering tests/meshing tests/export/test_decimate.py \
    tests/export/test_character.py tests/datasets/test_meshes.py tests/datasets/test_clothed.py tests/hydra_config tests/cli \
    tests/commands/test_train.py tests/commands/test_doctor.py tests/evaluation
