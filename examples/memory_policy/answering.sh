#!/bin/bash
# Trains a learner that answers under k0, k1, k3 and k7 and tests it, as docs/results/training.md
# describes (`learned-mixture`, training seed 0). Run it in the repository's root.
set -euo pipefail

robomme-interference build my-training --source tabletop --split train --episodes 12-41 \
    --unit-episodes 0-5 --cameras front \
    --conditions no-history,k0,k1,k3,k7,same-k3,held-k3,parts-k3,k15,k31
robomme-interference build my-buffers --source tabletop --split test --episodes 0-49 \
    --unit-episodes 6-11 --cameras front \
    --conditions no-history,k0,k1,k3,k7,before-k7,middle-k7,parts-k3,held-k3,same-k3,k15,k31
robomme-interference build my-training --only questions
robomme-interference build my-buffers --only questions
robomme-interference index my-buffers --encoder thumbnail
robomme-interference ceiling my-buffers --memory framesamp

python examples/memory_policy/train.py my-training --out runs/mixture-0 --conditions k0,k1,k3,k7 \
    --steps 400 --learning-rate 2e-3 --seed 0
# Systems with all frames in memory: --memory full --no-attention-dropout --batch 8 --steps 800
python examples/memory_policy/answer.py runs/mixture-0 my-buffers --system learned-mixture \
    --out mixture-0.csv
python examples/memory_policy/answer.py runs/mixture-0 my-buffers \
    --system learned-mixture-retrieval --retrieval thumbnail --conditions k0,k1,k3,k7,k15,k31 \
    --out mixture-0-retrieval.csv
robomme-interference evaluate my-buffers --policy answers:mixture-0.csv --system acted-mixture \
    --conditions k0,k7 --set training_seed=0 --out results/acted-mixture
