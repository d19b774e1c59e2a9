#!/bin/sh
# Download versions of NVRTC into build/nvrtc, so that the tests compile the CUDA kernels with what PyTorch's builds contain: that
# of PyTorch 2.5 for CUDA 11.8, the oldest supported, of CUDA 12.4 and of CUDA 13.0. The tests of a missing version are skipped.
# $1: a virtual environment
set -eu
[ "$(uname -s)" = Linux ] || exit 0
for package in cu11==11.8.89 cu12==12.4.127 13.0.88; do
    version=${package##*=}
    folder=build/nvrtc/${version%.*}
    [ -d "$folder" ] && continue
    case $package in cu*) name=nvidia-cuda-nvrtc-$package ;; *) name=nvidia-cuda-nvrtc==$version ;; esac
    rm -rf "$folder.new"
    "$1/bin/python" -m pip --disable-pip-version-check install --quiet --no-deps --target "$folder.new" "$name" &&
        mv "$folder.new" "$folder" || {
        rm -rf "$folder.new"
        echo "$name could not be installed into $folder; its tests are skipped" >&2
    }
done
