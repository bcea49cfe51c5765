#!/usr/bin/env bash
# Makes .venv hold exactly the packages pinned in requirements.txt and, editable, this package and
# the example's LeRobot policy, which LeRobot finds only if it is installed.
# Does nothing, and says nothing, while its inputs are those of the last time.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

venv=.venv
stamp=$venv/.setup
plugin=examples/lerobot_policy_history_act

say() { printf 'setup: %s\n' "$*" >&2; }

# What the environment depends on; the folder too, because its scripts hold absolute paths.
inputs() { pwd; cat requirements.txt pyproject.toml "$plugin/pyproject.toml"; }

is_312() { "$1" -c 'import sys; sys.exit(sys.version_info[:2] != (3, 12))' 2>/dev/null; }

# A folder that was moved, or an interrupted set-up, can leave an environment that does not work.
is_usable() {
  [[ ! -e $stamp || $(head -n 1 "$stamp") == "$PWD" ]] && is_312 "$venv/bin/python" &&
    "$venv/bin/python" -m pip --version &>/dev/null
}

find_python() {
  local name
  for name in python3.12 python3; do
    if is_312 "$name" && "$name" -c 'import ensurepip' 2>/dev/null; then
      echo "$name"
      return
    fi
  done
}

pinned_uv() { grep '^uv==' requirements.txt; }

make_venv() {
  local python
  python=$(find_python)
  rm -rf "$venv"
  if [[ -n $python ]]; then
    "$python" -m venv "$venv"
    return
  fi
  # No Python 3.12 here, as on Debian 12: uv, installed by any Python, can bring one.
  say "no Python 3.12 found: uv is asked for one ..."
  if ! python3 -c 'import ensurepip' 2>/dev/null && [[ $EUID == 0 ]] && command -v apt-get; then
    apt-get -qq update && DEBIAN_FRONTEND=noninteractive apt-get -qq install --yes python3-venv
  fi &>/dev/null || true
  rm -rf build/uv
  if python3 -m venv build/uv &&
    build/uv/bin/python -m pip install -qq --disable-pip-version-check "$(pinned_uv)" &&
    build/uv/bin/uv venv --quiet --seed --python 3.12 "$venv"; then
    return
  fi >&2
  say "Python 3.12 is needed. Install it with its venv module (pyenv install 3.12, or your"
  say "system's python3.12 and python3.12-venv packages) so that python3.12 runs, then try again."
  exit 1
}

if inputs | cmp -s - "$stamp"; then exit; fi

say "installing the pinned packages into $venv (6 GB; a few minutes the first time) ..."
is_usable || make_venv
rm -f "$stamp"
python=$venv/bin/python
"$python" -m pip install -qq --disable-pip-version-check --root-user-action ignore "$(pinned_uv)"
# uv does not read pip's settings: use the same index as pip does.
index=${PIP_INDEX_URL:-$("$python" -m pip config get global.index-url 2>/dev/null || true)}
if [[ -n $index ]]; then export UV_DEFAULT_INDEX=${UV_DEFAULT_INDEX:-$index}; fi
"$venv/bin/uv" pip sync --quiet --python "$python" requirements.txt
# setuptools is among the pinned packages, so the build needs nothing more from the index.
"$venv/bin/uv" pip install --quiet --python "$python" --no-deps --no-build-isolation \
  --editable . --editable "./$plugin"
inputs > "$stamp"
