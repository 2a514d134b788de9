#!/usr/bin/env bash
# Plays the shipped policies, and the two that need no learning, on the frozen evaluation scenes: one JSON file a cell, with how each scene
# ended. Cells that are there are left alone. The avoider plays 60 episodes: it only has to show that nearly all scenes can be solved.
#   benchmarks/evaluate_cells.sh [SIMULATOR] [EPISODES] [FOLDER]
set -euo pipefail
simulator=${1:-bullet}
episodes=${2:-300}
folder=${3:-benchmarks/results/$simulator}
# Networks round differently in batches of another size, so that the chunk belongs to a result.
case $simulator in bullet) chunk=20 ;; *) chunk=150 ;; esac
export GLIBC_TUNABLES=glibc.malloc.hugetlb=1 OMP_NUM_THREADS=1

# play NAME WHO SCENARIO SIZE K
play() {
  local file="$folder/$1-$3-$4-K$5.json"
  [ -e "$file" ] && return
  # shellcheck disable=SC2086 -- WHO is a flag and its value
  cura-torchrl evaluate $2 --scenario "$3" --object-size "$4" --max-obstacles "$5" --episodes "$episodes" --seed 0 \
    --num-workers 2 --chunk "$chunk" --simulator "$simulator" --json > "$file.partial"
  mv "$file.partial" "$file"
}

mkdir -p "$folder"
for size in 0.5 0.75 1.0; do
  for scenario in uniform adversarial; do
    for method in push-no-occlusion push cura-ppo; do
      play "$method" "--method $method" "$scenario" "$size" 6
    done
  done
done
for size in 0.5 0.75 1.0; do
  play scripted "--policy scripted" uniform "$size" 0
  for scenario in adversarial uniform; do
    episodes=60 play avoider "--policy avoider" "$scenario" "$size" 6
  done
done
python benchmarks/results_table.py "$folder"
