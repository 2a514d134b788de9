#!/usr/bin/env bash
# Trains methods on the planar simulator, one after the other, each from a warm start that imitates the scripted avoider with what the
# method sees. Run it again after an interruption, or with more frames: each run goes on from where it was.
#   benchmarks/train_on_planar.sh RUNS FRAMES METHOD... [-- FLAG...]
# FLAG... is handed to `cura-torchrl train`. ENCODER=<file> takes another encoder than the one that is shipped, SEED=<n> another seed,
# NAME=<folder> another name than METHOD-SEED, START=<run> another start, WORKERS=<n> processes, DEVICE=cuda the whole of it on a GPU.
# benchmarks/training/imitate-* are the warm starts that the shipped policies come from.
set -euo pipefail
runs=$1 frames=$2
shift 2
methods=()
while [ $# -gt 0 ] && [ "$1" != -- ]; do
  methods+=("$1")
  shift
done
[ $# -eq 0 ] || shift
seed=${SEED:-0}
encoder=(${ENCODER:+--encoder "$ENCODER"})
if [ "${DEVICE:-cpu}" = cpu ]; then
  where=(--device cpu --num-workers "${WORKERS:-2}")
else
  where=(--device "$DEVICE" --num-workers 1 --env.physics.planar-graph)
fi
export OMP_NUM_THREADS=1

for method in "${methods[@]}"; do
  # The warm start depends on what the LiDAR and the map show, not on the costs: methods that see the same share it.
  case $method in
    push | push-no-occlusion) sees=$method ;;
    *) sees=push-conf ;;
  esac
  start=${START:-$runs/imitate-$sees} run=$runs/${NAME:-$method-$seed}
  if [ -z "${START:-}" ] && [ ! -d "$start/checkpoints" ]; then
    cura-torchrl imitate --run-dir "$start" --expert avoider --method "$sees" --simulator planar "${encoder[@]}" --num-envs 1024 \
      --rounds 8 --steps 150 --epochs 15 --minibatch-size 2048
  fi
  if [ -d "$run/checkpoints" ]; then
    cura-torchrl train --run-dir "$run" --total-frames "$frames" --resume "${where[@]}"
  else
    cura-torchrl train --method "$method" --simulator planar "${where[@]}" --num-envs 4096 --total-frames "$frames" --seed "$seed" \
      --run-dir "$run" --init-from "$start" "${encoder[@]}" --ppo.rollout-steps 12 --ppo.minibatch-size 8192 --ppo.lr 3e-4 \
      --ppo.critic-warmup-frames 400000 --cura.costs-start-frames 400000 --ppo.entropy-coeff 0.001 --ppo.target-kl 0.02 \
      --network.min-std 0.15 --env.task.curriculum 0 6 "$@"
  fi
done
