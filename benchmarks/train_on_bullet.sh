#!/usr/bin/env bash
# Trains on PyBullet what the package ships: encoder, warm start, then `push` and `cura-ppo` on one schedule.
# Run it again after an interruption: each step goes on from where it was.
#   benchmarks/train_on_bullet.sh [RUNS] [FRAMES]
set -euo pipefail
runs=${1:-runs}
frames=${2:-1750000}
weights=cura_torchrl/modules/weights

if [ ! -e "$weights/map_vae.pt" ]; then
  cura-torchrl pretrain-map --run-dir "$runs/map_vae"
  mkdir -p "$weights"
  cp "$runs/map_vae/map_vae.pt" "$runs/map_vae/map_vae.json" "$weights/"
fi

[ -d "$runs/imitate/checkpoints" ] || cura-torchrl imitate --run-dir "$runs/imitate"

# Side by side, one process each: on two cores that keeps both busy while the other's learner updates.
for method in push cura-ppo; do
  if [ -d "$runs/$method/checkpoints" ]; then
    cura-torchrl train --run-dir "$runs/$method" --total-frames "$frames" --resume &
  else
    cura-torchrl train --method "$method" --simulator bullet --num-envs 32 --num-workers 1 --total-frames "$frames" --seed 0 \
      --run-dir "$runs/$method" --init-from "$runs/imitate" --ppo.rollout-steps 64 --ppo.minibatch-size 512 --ppo.lr 3e-4 \
      --ppo.critic-warmup-frames 40000 --ppo.entropy-coeff 0.001 --learner-threads 1 &
  fi
done
wait
