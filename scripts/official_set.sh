#!/usr/bin/env bash
# Builds, checks and publishes a buffer set that has a reference plan:
#
#     scripts/official_set.sh official ~/official --shard 1/8      on each of eight machines
#     scripts/official_set.sh official ~/official                  where all shards are, or alone
#     scripts/official_set.sh official ~/official --publish my-name/official
#     scripts/official_set.sh tutorial ~/tutorial
#     scripts/official_set.sh my-plan.json ~/mine -- --source frames:mine --conditions k0,k7
#
# FOLDER/shards/ holds the shards and FOLDER/buffers the buffer set. Without shards it is built at
# once. Then it is indexed, verified against its plan, audited, and its card is written. Nothing is
# published without --publish. After an interruption, run the same command again.
set -euo pipefail

say() { printf 'official_set: %s\n' "$*" >&2; }
fail() {
  say "$1"
  say "$2"
  exit 1
}

[[ $# -ge 2 ]] || fail "expected a plan and a folder, got $# words" \
  "Usage: $0 official|tutorial|PLAN FOLDER [--shard I/N] [--publish NAME] [-- BUILD OPTIONS]"
plan=$1 folder=$2 shard='' repository=''
shift 2
while [[ $# -gt 0 && $1 != -- ]]; do
  [[ $# -ge 2 ]] || fail "$1 has no value" "Give one, such as --shard 1/8."
  case $1 in
    --shard) shard=$2 ;;
    --publish) repository=$2 ;;
    *) fail "unknown option $1" "Options of build come after --, as in: -- --workers 2" ;;
  esac
  shift 2
done
[[ ${1-} != -- ]] || shift
[[ $shard != 1/1 ]] || shard=''  # the whole

license=other
case $plan in
  official)
    options=(--source robomme --split test --episodes 0-49 --unit-episodes 0-7)
    license=apache-2.0
    ;;
  tutorial)
    options=(--source tabletop --split test --episodes 0-1 --unit-episodes 0 --cameras front
      --families MoveCube,PatternLock,RouteStick --conditions no-history,k0,k7,raw-k7)
    license=apache-2.0
    ;;
  *)
    [[ -f $plan ]] || fail "there is no plan $plan" "Give official, tutorial, or a plan's file."
    options=()
    ;;
esac
options+=("$@")

program=$(command -v robomme-interference ||
  command -v "$(dirname "${BASH_SOURCE[0]}")/../.venv/bin/robomme-interference") ||
  fail "robomme-interference is not installed" "Run make install first."
run() {
  say "robomme-interference $*"
  "$program" "$@"
}

mkdir -p "$folder"
if [[ -n $shard ]]; then
  run build "$folder/shards/${shard/\//-of-}" "${options[@]}" --shard "$shard"
  exit
fi

buffers=$folder/buffers
if [[ ! -d $folder/shards ]]; then
  run build "$buffers" "${options[@]}"
elif [[ ! -f $buffers/manifests/manifest.json || -f $buffers/shard.json ]]; then
  run merge "$folder"/shards/* --out "$buffers"
fi
run index "$buffers"
run verify "$buffers" --against "$plan" --audit
published=(--repo-id "${repository:-namespace/name}" --license "$license")
run card "$buffers" "${published[@]}" > "$folder/card.md"
if [[ -n $repository ]]; then
  run publish "$buffers" "${published[@]}" --yes
else
  say "nothing is published. Read $folder/card.md, log in with hf auth login, and add:"
  echo "--publish NAMESPACE/NAME"
fi
