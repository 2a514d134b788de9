#!/usr/bin/env bash
# Trains methods on the planar simulator, side by side with a process each, from one warm start.
# Run it again after an interruption, or with more frames: each run goes on from where it was.
#   benchmarks/train_on_planar.sh RUNS FRAMES METHOD...
# ENCODER=<file> takes another encoder than the one that is shipped, SEED=<n> another seed. benchmarks/training/map_vae.pt is the
# encoder of both simulators' maps that the experiments in docs/research were run with.
set -euo pipefail
runs=$1 frames=$2
shift 2
seed=${SEED:-0}
export OMP_NUM_THREADS=1

if [ ! -d "$runs/imitate/checkpoints" ]; then
  cura-torchrl imitate --run-dir "$runs/imitate"
fi

pids=()
for method in "$@"; do
  run=$runs/$method-$seed
  if [ -d "$run/checkpoints" ]; then
    cura-torchrl train --run-dir "$run" --total-frames "$frames" --resume &
  else
    cura-torchrl train --method "$method" --simulator planar --num-envs 1024 --total-frames "$frames" --seed "$seed" \
      --run-dir "$run" --init-from "$runs/imitate" ${ENCODER:+--encoder "$ENCODER"} --ppo.rollout-steps 24 \
      --ppo.minibatch-size 2048 --ppo.lr 3e-4 --ppo.critic-warmup-frames 100000 --ppo.entropy-coeff 0.001 \
      --ppo.target-kl 0.02 --network.min-std 0.15 --learner-threads 1 &
  fi
  pids+=($!)
done
for pid in "${pids[@]}"; do
  wait "$pid"
done
