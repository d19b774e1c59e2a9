#!/bin/sh
# Make the virtual environment $1 (with $PYTHON) and install snarf into it, with the extra $2: commands, or test (if there is none).
# An installed PyTorch is kept. Otherwise a machine with an NVIDIA driver gets the default build, and any other the CPU build,
# which is gigabytes smaller. No newer pip is needed than the one that Python brings.
set -eu
venv=$1
extra=${2:-test}
python=${PYTHON:-python3}
"$python" -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2])' || {
    echo "snarf needs Python 3.10 or newer; $python is $("$python" --version 2>&1). Give another one: make PYTHON=python3.12" >&2
    exit 2
}
[ -x "$venv/bin/python" ] || "$python" -m venv "$venv" || {
    echo "could not make a virtual environment; on Debian and Ubuntu: apt install python3-venv" >&2
    exit 2
}
pip="$venv/bin/python -m pip --disable-pip-version-check"
echo "installing snarf and the packages of its extra '$extra' into $venv; this takes some minutes"
if ! "$venv/bin/python" -c 'import torch' 2>/dev/null; then
    if [ "$(uname -s)" = Linux ] && ! command -v nvidia-smi >/dev/null 2>&1; then
        # First from the configured package index, then from PyTorch's index of CPU builds.
        $pip install --quiet 'torch==2.13.0+cpu' 2>/dev/null ||
            $pip install --quiet 'torch==2.13.0' --index-url https://download.pytorch.org/whl/cpu
    else
        $pip install --quiet 'torch>=2.5'
    fi
fi
$pip install --quiet --editable ".[$extra]"
[ "$extra" = test ] || exit 0
# Independent readers of glTF, VRM and BVH for the tests. The tests are skipped without them: npm or the network may be missing.
readers=build/readers
if command -v npm >/dev/null 2>&1 && ! cmp -s tests/readers/package.json $readers/package.json; then
    mkdir -p $readers.new && cp tests/readers/package.json $readers.new/ &&
        npm install --prefix $readers.new --ignore-scripts --no-audit --no-fund --silent --fetch-retries=1 --fetch-timeout=30000 &&
        rm -rf $readers && mv $readers.new $readers || {
        rm -rf $readers.new
        echo "three.js, three-vrm and the Khronos validator could not be installed into $readers; their tests are skipped" >&2
    }
fi
touch "$venv/.snarf-installed"
