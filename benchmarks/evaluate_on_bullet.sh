#!/usr/bin/env bash
# Plays the shipped policies, and the two that need no learning, on the frozen evaluation scenes: one JSON file a cell.
# Without obstacles both scenarios are the same scenes, so K = 0 is played once. Cells that are there are left alone.
# The avoider plays 60 episodes: it only has to show that nearly all scenes can be solved.
#   benchmarks/evaluate_on_bullet.sh [FOLDER] [EPISODES]
set -euo pipefail
folder=${1:-benchmarks/results/bullet}
episodes=${2:-200}
export GLIBC_TUNABLES=glibc.malloc.hugetlb=1

# play NAME WHO SCENARIO SIZE K
play() {
  local file="$folder/$1-$3-$4-K$5.json"
  [ -e "$file" ] && return
  # shellcheck disable=SC2086 -- WHO is a flag and its value
  cura-torchrl evaluate $2 --scenario "$3" --object-size "$4" --max-obstacles "$5" --episodes "$episodes" --seed 0 \
    --num-workers 2 --simulator bullet --json > "$file.partial"
  mv "$file.partial" "$file"
}

mkdir -p "$folder"
for size in 0.5 0.75 1.0; do
  for method in cura-ppo push; do
    play "$method" "--method $method" adversarial "$size" 2
    play "$method" "--method $method" uniform "$size" 2
    play "$method" "--method $method" uniform "$size" 0
  done
done
for size in 0.5 0.75 1.0; do
  play scripted "--policy scripted" uniform "$size" 0
  for scenario in adversarial uniform; do
    play scripted "--policy scripted" "$scenario" "$size" 2
    episodes=60 play avoider "--policy avoider" "$scenario" "$size" 6
  done
done
python benchmarks/results_table.py "$folder"
