#!/usr/bin/env bash
# Installs RoboMME from a clone of its repository into an environment of its own (7.5 GB):
#
#     scripts/install_robomme.sh ~/robomme_benchmark ~/robomme
#
# Its versions are those of the clone's own uv.lock, except ManiSkill: RoboMME's fork is replaced by
# the published 3.0.1, which differs in three things that are patched when RoboMME starts. After an
# interruption, run the same command again.
set -euo pipefail

say() { printf 'install_robomme: %s\n' "$*" >&2; }
fail() {
  say "$1"
  say "$2"
  exit 1
}

[[ $# == 2 ]] || fail "expected two folders, got $#" "Usage: $0 CLONE ENV"
clone=$1 env=$2 here=$(dirname "${BASH_SOURCE[0]}")

[[ -d $clone ]] || fail "there is no folder $clone" \
  "Clone it first: git clone https://github.com/RoboMME/robomme_benchmark $clone"
clone=$(cd "$clone" && pwd)
grep -qs '^name = "robomme"$' "$clone/pyproject.toml" && [[ -d $clone/src/robomme ]] ||
  fail "$clone is not a clone of RoboMME: it has no src/robomme of that name" \
    "Clone it: git clone https://github.com/RoboMME/robomme_benchmark"
[[ -f $clone/uv.lock ]] || fail "$clone has no uv.lock, which lists RoboMME's versions" \
  "Check out its main branch: git -C $clone checkout main"
commit=$(git -C "$clone" describe --always --abbrev=40 --dirty --exclude='*' 2>/dev/null) ||
  fail "$clone has no commit, so runs could not record which RoboMME they used" \
    "Use a git clone instead of an unpacked archive."

if [[ -e $env && ! -f $env/pyvenv.cfg && -n $(ls -A "$env") ]]; then
  fail "$env exists and is no Python environment" "Choose a new folder."
fi
uv=$(command -v uv || command -v "$here/../.venv/bin/uv") ||
  fail "uv is missing, which reads RoboMME's lock" "Install it: python -m pip install uv"
# uv does not read pip's settings: use the same index as pip does.
index=${PIP_INDEX_URL:-$(python3 -m pip config get global.index-url 2>/dev/null || true)}
if [[ -n $index ]]; then export UV_DEFAULT_INDEX=${UV_DEFAULT_INDEX:-$index}; fi

say "RoboMME at commit $commit, into $env ..."
[[ -f $env/pyvenv.cfg ]] || "$uv" venv --quiet --python 3.11 "$env"
python=$(cd "$env" && pwd)/bin/python
lock=$(mktemp)
trap 'rm -f "$lock"' EXIT
# The versions and hashes alone: they install from the index that is set up on this machine.
"$uv" export --quiet --frozen --project "$clone" --no-dev --no-emit-project \
  --no-emit-package mani-skill --no-emit-package pytorch-kinematics --output-file "$lock" >/dev/null
"$uv" pip sync --quiet --python "$python" "$lock"
# What ManiSkill 3.0.1 needs beyond the lock, which is of its predecessor.
"$uv" pip install --quiet --python "$python" --no-deps \
  mani-skill==3.0.1 defusedxml==0.7.1 pytorch-kinematics==0.7.6
# Editable, so that it keeps to the commit of the clone, which runs record.
"$uv" pip install --quiet --python "$python" --no-deps --editable "$clone"
"$python" -c 'import robomme.env_record_wrapper' || fail "RoboMME cannot be imported in $env" \
  "A missing system library is named above: scripts/system_packages.sh lists those of Vulkan."
say "done: $(du -sh "$env" | cut -f1). Next:"
echo "export ROBOMME_PYTHON=$python"
echo "robomme-interference doctor"
