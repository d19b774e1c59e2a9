#!/bin/sh
# Build the native library with AddressSanitizer and UndefinedBehaviorSanitizer into build/sanitize and run tests on it, with
# the tools in the virtual environment $1. Further arguments are pytest's; without any, the tests that call the library.
# Fails where a test fails, on the sanitizers' first report, and if the library leaks memory.
set -eu
venv=$(cd "$1" && pwd)
shift
cd "$(dirname "$0")/.."
[ $# -gt 0 ] || set -- tests/deformer/test_gradient.py tests/native/test_library.py tests/deformer/test_native_search.py tests/deformer/test_ops.py tests/deformer/test_posed.py tests/deformer/test_posed_gradients.py tests/deformer/test_posed_skinning.py tests/deformer/test_search.py tests/deformer/test_starts.py tests/shape/test_inference.py tests/networks tests/native/test_threads.py tests/training/test_optimizer.py tests/deformer/test_weights.py
folder=$PWD/build/sanitize
compiler=${CXX:-c++}
"$venv/bin/cmake" -S . -B "$folder" -G Ninja -DCMAKE_MAKE_PROGRAM="$venv/bin/ninja" -DSNARF_SANITIZE=ON -DSNARF_REQUIRE_NATIVE=ON
"$venv/bin/cmake" --build "$folder"

# Python is not instrumented, so the sanitizers' libraries must be loaded before it; libstdc++ too, because
# AddressSanitizer looks for its __cxa_throw at the start.
preload=
for library in libasan.so "libclang_rt.asan-$(uname -m).so" libstdc++.so; do
    path=$($compiler -print-file-name="$library")
    [ "$path" = "$library" ] || preload="$preload $path"
done
rm -f "$folder"/report.*
# Python does not free all memory at its end, hence exitcode=0: only leaks of the library count, see below. Any other report
# aborts the process. Without PYTHONMALLOC every object in Python's arenas would be reported as a leak.
status=0
LD_PRELOAD=$preload SNARF_NATIVE_LIBRARY=$folder/libsnarf_native.so PYTHONMALLOC=malloc LSAN_OPTIONS=exitcode=0 \
ASAN_OPTIONS=detect_leaks=1:abort_on_error=1:log_path=$folder/report UBSAN_OPTIONS=print_stacktrace=1:abort_on_error=1 \
    "$venv/bin/python" -m pytest -q -p no:cacheprovider --capture=sys "$@" || status=$?
reports=$(grep -lE 'csrc/|libsnarf_native|ERROR: AddressSanitizer|runtime error:' "$folder"/report.* 2>/dev/null || true)
if [ -n "$reports" ]; then
    cat $reports >&2
    echo "sanitize: the reports above concern the native library" >&2
    status=1
fi
exit $status
