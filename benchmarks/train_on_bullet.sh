#!/usr/bin/env bash
# Trains on PyBullet what the package ships: encoder, warm start, then `push` and `cura-ppo` on one schedule.
# Run it again after an interruption: each step goes on from where it was.
#   benchmarks/train_on_bullet.sh [RUNS] [FRAMES]
set -euo pipefail
runs=${1:-runs}
frames=${2:-1500000}
weights=cura_torchrl/modules/weights
export OMP_NUM_THREADS=1
# Huge pages, where there are any: PyBullet spreads a world over many pages. `cura-torchrl bench env` shows what they bring.
export GLIBC_TUNABLES=glibc.malloc.hugetlb=1

if [ ! -e "$weights/map_vae.pt" ]; then
  cura-torchrl pretrain-map --num-envs 32 --keep-every 1 --epochs 5 --batch-size 64 --run-dir "$runs/map_vae"
  mkdir -p "$weights"
  cp "$runs/map_vae/map_vae.pt" "$runs/map_vae/map_vae.json" "$weights/"
fi

has_begun() { [ -d "$runs/$1/checkpoints" ]; }
if ! has_begun imitate && ! { has_begun push && has_begun cura-ppo; }; then
  cura-torchrl imitate --run-dir "$runs/imitate"
fi

# Side by side, one process each: on two cores that keeps both busy while the other's learner updates.
pids=()
for method in push cura-ppo; do
  if has_begun "$method"; then
    cura-torchrl train --run-dir "$runs/$method" --total-frames "$frames" --resume &
  else
    cura-torchrl train --method "$method" --simulator bullet --num-envs 32 --num-workers 1 --total-frames "$frames" --seed 0 \
      --run-dir "$runs/$method" --init-from "$runs/imitate" --ppo.rollout-steps 64 --ppo.minibatch-size 512 --ppo.lr 3e-4 \
      --ppo.critic-warmup-frames 40000 --ppo.entropy-coeff 0.001 --ppo.target-kl 0.02 --network.min-std 0.15 --learner-threads 1 &
  fi
  pids+=($!)
done
for pid in "${pids[@]}"; do
  wait "$pid"
done
for method in push cura-ppo; do
  cura-torchrl release --checkpoint "$runs/$method"
done
