#!/bin/bash
# Trains and tests the controls of docs/results/training.md with three seeds: `controls.sh answers`,
# or `controls.sh acts`, which needs a GPU. First, answering.sh or acting.sh builds the data. Run it
# in the repository's root.
set -euo pipefail
export PYTHONPATH=examples/memory_policy
data=my-training
mixture=k0,k1,k3,k7

declare -A controls=(
    [held]="--conditions held-k1,held-k3,held-k7"
    [k7]="--conditions k7"
    [places]="--conditions $mixture,before-k7,middle-k7"
    [k0-shifted]="--conditions k0 --positions shifted"
    [k0-relative]="--conditions k0 --positions relative"
    [k0-absolute]="--conditions k0 --positions absolute"
)
if [ "$1" = acts ]; then
    data=acting-training
    # The learner that answers has three seeds of these already.
    controls+=(
        [blind-k0]="--conditions k0 --no-pictures"
        [blind-mixture]="--conditions $mixture --no-pictures"
        [window-k0]="--conditions k0 --memory window:32"
        [window-mixture]="--conditions $mixture --memory window:32"
        [gru-k0]="--conditions k0 --trunk gru"
        [gru-mixture]="--conditions $mixture --trunk gru"
    )
fi

robomme-interference build "$data" --only manifests --conditions held-k1,held-k7,before-k7,middle-k7
for name in "${!controls[@]}"; do
    for seed in 0 1 2; do
        run=runs/$1-$name-$seed
        if [ "$1" = answers ]; then
            python examples/memory_policy/train.py "$data" --out "$run" ${controls[$name]} \
                --steps 400 --learning-rate 2e-3 --seed $seed
            python examples/memory_policy/answer.py "$run" my-buffers --system "learned-$name" \
                --out "learned-$name-$seed.csv"
        else
            python examples/memory_policy/train.py "$data" --task act --out "$run" \
                ${controls[$name]} --width 192 --layers 3 --batch 64 --steps 6300 --workers 1 \
                --seed $seed
            robomme-interference evaluate acting-buffers \
                --policy python:memory_policy:MemoryPolicy --policy-option checkpoint="$run" \
                --system "acts-$name" --set training_seed=$seed --set cache=true \
                --out "results/acts-$name-$seed"
        fi
    done
done
