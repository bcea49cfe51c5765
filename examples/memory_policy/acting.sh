#!/bin/bash
# Trains a policy that acts under k0, k1, k3 and k7 and tests it, as docs/results/training.md
# describes (`acts-mixture`, training seed 0). Run it in the repository's root.
set -euo pipefail
export PYTHONPATH=examples/memory_policy

robomme-interference build acting-training --source tabletop --split train \
    --families MoveCube,PatternLock,RouteStick --episodes 12-111 --unit-episodes 0-5 \
    --cameras front --with executions \
    --conditions no-history,k0,k1,k3,k7,same-k3,held-k3,parts-k3
robomme-interference build acting-buffers --source tabletop --split test \
    --families MoveCube,PatternLock,RouteStick --episodes 0-49 --unit-episodes 6-11 \
    --cameras front \
    --conditions no-history,k0,k1,k3,k7,k15,k31,same-k3,held-k3,parts-k3,before-k7,middle-k7
robomme-interference index acting-buffers --encoder thumbnail
robomme-interference ceiling acting-buffers --memory framesamp

# The weights of the rows are those of step 6,000 (acts-gru-mixture and acts-wide: 6,300).
python examples/memory_policy/train.py acting-training --task act --out runs/acts-mixture-0 \
    --conditions k0,k1,k3,k7 --width 192 --layers 3 --batch 64 --steps 6300 --workers 1 --seed 0
robomme-interference evaluate acting-buffers \
    --policy python:memory_policy:MemoryPolicy --policy-option checkpoint=runs/acts-mixture-0 \
    --system acts-mixture --set training_seed=0 --set cache=true --out results/acts-mixture-0
robomme-interference evaluate acting-buffers \
    --policy python:memory_policy:MemoryPolicy --policy-option checkpoint=runs/acts-mixture-0 \
    --system acts-mixture-retrieval --retrieval thumbnail --conditions k7,k31 \
    --set training_seed=0 --set cache=true --out results/acts-mixture-retrieval-0
robomme-interference evaluate acting-buffers \
    --policy python:memory_policy:MemoryPolicy --policy-option checkpoint=runs/acts-mixture-0 \
    --system acts-mixture --shift light:2 --conditions k0,k7 --episodes 0-24 \
    --set training_seed=0 --set cache=true --out results/acts-mixture-0-light
