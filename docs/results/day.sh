#!/bin/bash
# Builds twelve test days and measures what docs/results/day.md states: `day.sh` builds, asks and
# grades; then `day.sh act` rolls out the queries of three families, and `day.sh learn` trains the
# answering example on twelve train days, and tests it. Run it in an empty folder.
set -euo pipefail
conditions=no-history,day-alone,day-k0,day-k1,day-k3,day-k7,day-cut-k0,day-cut-k1,day-cut-k3,day-cut-k7
build_days() {
    robomme-interference build "$1" --source tabletop-day --split "$2" --episodes 0-11 \
        --unit-episodes 0-3 --cameras front --position-limit none --conditions $conditions
    robomme-interference build "$1" --only questions
}

if [ "${1:-}" = act ]; then
    roll() {
        robomme-interference evaluate test-days --simulator tabletop-day \
            --families MoveCube,PatternLock,RouteStick --set cache=true "$@"
    }
    roll --policy replay:framesamp --conditions day-alone,day-k7,day-cut-k7 --out acted/replay
    for rule in window windows3 changes; do
        roll --policy replay:framesamp --conditions day-k7 --retrieval thumbnail \
            --retrieval-rule $rule --out acted/replay-$rule
    done
    exit
fi

if [ "${1:-}" = learn ]; then
    example=$(dirname "$0")/../../examples/memory_policy
    build_days train-days train
    learn() {
        local name=$1 conditions=$2 seed=$3
        python "$example/train.py" train-days --out "trained/$name-$seed" \
            --conditions "$conditions" --steps 400 --learning-rate 2e-3 --seed "$seed"
        python "$example/answer.py" "trained/$name-$seed" test-days --system "learned-$name" \
            --out "learned/$name-$seed.csv"
        python "$example/answer.py" "trained/$name-$seed" test-days --conditions day-k7 \
            --retrieval thumbnail --retrieval-rule windows3 \
            --system "learned-$name-windows3" --out "learned/$name-$seed-windows3.csv"
    }
    for seed in 0 1 2; do
        learn alone day-alone $seed
        learn stream day-k0,day-k1,day-k3,day-k7 $seed
    done
    exit
fi

build_days test-days test
robomme-interference index test-days --encoder thumbnail
robomme-interference verify test-days --audit --json > verify.json

declare -A memories=(
    [full]=full [framesamp-32]=framesamp:32 [framesamp-128]=framesamp:128 [window-60s]=window:60@2
)
for name in "${!memories[@]}"; do
    robomme-interference ceiling test-days --memory "${memories[$name]}" --json > "ceiling-$name.json"
    robomme-interference ask test-days --model recall --memory "${memories[$name]}" \
        --system "observer-$name" --out "asked/observer-$name"
    for rule in max window windows3 changes; do
        robomme-interference ask test-days --model recall --memory "${memories[$name]}" \
            --retrieval thumbnail --retrieval-rule $rule --conditions day-k7 \
            --system "observer-$name-$rule" --out "asked/observer-$name-$rule"
    done
done
for model in guess abstain; do
    robomme-interference ask test-days --model $model --conditions no-history,day-k7 --out asked/$model
done
robomme-interference retrieval-score test-days --rules max,window,windows3,changes,oracle \
    --conditions day-alone,day-k0,day-k7,day-cut-k7 --out graded
