#!/usr/bin/env bash
# Installs what loads and scores buffers into a new environment, at the pinned versions, and uses it
# on the repository's samples. The image `light` is made by this.
#
#     scripts/install_light.sh FOLDER
set -euo pipefail
[[ $# == 1 ]] || { echo "usage: scripts/install_light.sh FOLDER" >&2; exit 2; }
folder=$1
[[ $folder == /* ]] || folder=$PWD/$folder
[[ ! -e $folder || -f $folder/pyvenv.cfg ]] || {
  echo "install_light: $folder is no environment, and is kept: give a new folder" >&2
  exit 1
}
cd "$(dirname "${BASH_SOURCE[0]}")/.."
rm -rf "$folder"
python3 -m venv "$folder"
"$folder/bin/python" -m pip install -qq --disable-pip-version-check --root-user-action ignore \
  --no-compile --constraint requirements.txt '.[score]'
scores=$(mktemp -d)
trap 'rm -rf "$scores"' EXIT
"$folder/bin/robomme-interference" verify tests/golden/buffer_set
"$folder/bin/robomme-interference" score tests/golden/run --out "$scores/out" >/dev/null
