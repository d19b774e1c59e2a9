#!/bin/sh
# Make snarfcli/export/page/three.min.js: the parts of three.js that the page of "snarf export format=html" uses, in one file.
# Needs npm and its registry. The file is part of the package, so that exports need neither; its first lines are its licence.
set -eu
cd "$(dirname "$0")/.."
page=snarfcli/export/page
three=$(sed -n 's/.*"three": "\(.*\)".*/\1/p' tests/readers/package.json)
esbuild=0.28.2
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
npm install --prefix "$work" --no-audit --no-fund --silent "three@$three" "esbuild@$esbuild"
cp $page/three.entry.mjs "$work/entry.mjs"
"$work/node_modules/.bin/esbuild" "$work/entry.mjs" --bundle --minify --format=iife --global-name=SnarfThree --target=es2021 \
    --charset=ascii --legal-comments=none --log-level=warning --outfile="$work/three.js"
{
    printf '/*\nthree.js %s, https://threejs.org, bundled by tools/bundle_three.sh\n\n' "$three"
    cat "$work/node_modules/three/LICENSE"
    printf '*/\n'
    cat "$work/three.js"
} >"$work/three.min.js"
cp "$work/node_modules/three/LICENSE" $page/three.LICENSE
mv "$work/three.min.js" $page/three.min.js
