#!/usr/bin/env bash
# Does it stay brave? One run without costs, then branches from it that differ in their costs alone, two at a time.
#   benchmarks/research/bravery.sh RUNS BASE_FRAMES BRANCH_FRAMES
set -euo pipefail
runs=$1 base=$2 frames=$3
train=$(dirname "$0")/../train_on_planar.sh

branch() { # NAME METHOD FLAG...
  local name=$1 method=$2
  shift 2
  START=$runs/push-conf-0 WORKERS=1 "$train" "$runs/$name" "$frames" "$method" -- --learner-threads 1 \
    --ppo.critic-warmup-frames 0 --cura.costs-start-frames 0 "$@"
}
weigh() { # RISK_COEFF UNCERTAINTY_COEFF: beside an advantage of deviation 1
  echo --cura.advantage-scale zscore --cura.risk-coeff "$1" --cura.uncertainty-coeff "$2"
}

"$train" "$runs" "$base" push-conf
branch none push-conf & branch letter cura-ppo & wait
branch z-0.10 cura-ppo $(weigh 0.025 0.1) & branch z-0.25 cura-ppo $(weigh 0.0625 0.25) & wait
branch z-1.00 cura-ppo $(weigh 0.25 1.0) & branch z-0.25-state cura-ppo $(weigh 0.0625 0.25) --cura.cost-baseline state & wait
branch z-0.25-lmbda cura-ppo $(weigh 0.0625 0.25) --cura.cost-lmbda 0.95 &
branch z-0.25-placebo cura-ppo $(weigh 0.0625 0.25) --cura.shuffle-uncertainty & wait
