#!/usr/bin/env bash
# Continue the training of cloudfit on a folder of meshes, and measure both networks on meshes that were kept apart.
#
#     bash examples/03_train_on_own_meshes.sh MESHES HELD_OUT FOLDER [EPOCHS [OPTIONS OF jetnormal train]]
#
# A useful run has some twenty meshes and several epochs; FOLDER/run/metrics.csv shows whether it still learns.
set -euo pipefail

meshes=$1 held_out=$2 folder=$3 epochs=${4:-5}
shift $(($# < 4 ? $# : 4))
mkdir -p "$folder"
if [ ! -e "$folder/benchmark" ]; then
    jetnormal dataset --meshes "$held_out" --points 20000 --queries 1000 -o "$folder/benchmark"
fi
jetnormal train --initial cloudfit --data "$meshes" --validation "$held_out" \
    --epochs "$epochs" --set learning_rate=5e-4 -o "$folder/run" "$@"
jetnormal evaluate --data "$folder/benchmark" --model cloudfit --model "$folder/run/model.safetensors"
