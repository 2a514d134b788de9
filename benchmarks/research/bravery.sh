#!/usr/bin/env bash
# Does it stay brave? One run without costs, then branches from it that differ in their costs alone, two at a time.
#   benchmarks/research/bravery.sh RUNS BASE_FRAMES BRANCH_FRAMES
# The page's runs were made at commit 674f3ca, whose recipe and warm start were other ones: check it out to repeat them.
set -euo pipefail
runs=$1 base=$2 frames=$3
train=$(dirname "$0")/../train_on_planar.sh
worlds=(--num-envs 1024 --ppo.rollout-steps 24 --ppo.minibatch-size 6144)

branch() { # NAME METHOD FLAG...
  local name=$1 method=$2
  shift 2
  START=$runs/push-conf-0 WORKERS=1 "$train" "$runs/$name" "$frames" "$method" -- --learner-threads 1 "${worlds[@]}" \
    --ppo.critic-warmup-frames 0 --cura.costs-start-frames 0 "$@"
}
costs() { # ADVANTAGE_SCALE RISK_COEFF UNCERTAINTY_COEFF
  echo --cura.advantage-scale "$1" --cura.cost-baseline mean --cura.risk-coeff "$2" --cura.uncertainty-coeff "$3"
}
weigh() { # RISK_COEFF UNCERTAINTY_COEFF: beside an advantage of deviation 1
  costs zscore "$@"
}

"$train" "$runs" "$base" push-conf -- "${worlds[@]}" --ppo.critic-warmup-frames 250000
branch none push-conf & branch letter cura-ppo $(costs raw 0.25 1.0) & wait
branch z-0.10 cura-ppo $(weigh 0.025 0.1) & branch z-0.25 cura-ppo $(weigh 0.0625 0.25) & wait
branch z-1.00 cura-ppo $(weigh 0.25 1.0) & branch z-0.25-state cura-ppo $(weigh 0.0625 0.25) --cura.cost-baseline state & wait
branch z-0.25-lmbda cura-ppo $(weigh 0.0625 0.25) --cura.cost-lmbda 0.95 &
branch z-0.25-placebo cura-ppo $(weigh 0.0625 0.25) --cura.shuffle-uncertainty & wait
