#!/usr/bin/env bash
# The recipe of the shipped policies: trains methods on the planar simulator with `cura-torchrl train-all`, each from a warm start that
# imitates the scripted avoider with what the method sees. Run it again after an interruption, or with more frames: it goes on from there.
#   benchmarks/train_on_planar.sh RUNS FRAMES METHOD... [-- FLAG...]
# FLAG... is handed to `cura-torchrl train`. SEEDS=0,1,2 trains several seeds, JOBS=<n> runs side by side, WORKERS=<n> processes in each,
# DEVICE=cuda trains on a GPU. STARTS=<folder> holds the warm starts imitate-*, those that are missing are made there:
# benchmarks/training has those that the shipped policies come from, RUNS is the default. START=<run> is one start for all methods,
# ENCODER=<file> another encoder than the one that is shipped. STATUS=1 shows how far the runs are, and starts nothing.
set -euo pipefail
runs=$1 frames=$2
shift 2
methods=()
while [ $# -gt 0 ] && [ "$1" != -- ]; do
  methods+=("$1")
  shift
done
[ $# -eq 0 ] || shift
encoder=(${ENCODER:+--encoder "$ENCODER"})
if [ "${DEVICE:-cpu}" = cpu ]; then
  where=(--device cpu --num-workers "${WORKERS:-2}")
else
  where=(--device "$DEVICE" --num-workers 1 --env.physics.planar-graph)
fi
export OMP_NUM_THREADS=1

starts=(${START:+"$START"})
if [ -z "${START:-}" ]; then
  for method in "${methods[@]}"; do
    # The warm start depends on the robot, and on what LiDAR and map show, not on the costs: methods that see the same share it.
    case $method in
      push | push-no-occlusion | *-base) sees=$method ;;
      *) sees=push-conf ;;
    esac
    start=${STARTS:-$runs}/imitate-$sees
    starts+=("$method=$start")
    if [ ! -d "$start/checkpoints" ] && [ ! -e "$start/SHA256SUMS" ]; then
      cura-torchrl imitate --run-dir "$start" --expert avoider --method "$sees" --simulator planar "${encoder[@]}" --num-envs 1024 \
        --rounds 8 --steps 150 --epochs 15 --minibatch-size 2048
    fi
  done
fi
cura-torchrl train-all --methods "${methods[@]}" --seeds "${SEEDS:-0}" --total-frames "$frames" --simulator planar --runs "$runs" \
  --init-from "${starts[@]}" ${JOBS:+--jobs "$JOBS"} ${STATUS:+--status} -- \
  --num-envs 4096 "${where[@]}" "${encoder[@]}" --ppo.rollout-steps 12 --ppo.minibatch-size 8192 --ppo.lr 3e-4 \
  --ppo.critic-warmup-frames 400000 --cura.costs-start-frames 400000 --ppo.entropy-coeff 0.001 --ppo.target-kl 0.02 \
  --network.min-std 0.15 --env.task.curriculum 0 6 "$@"
