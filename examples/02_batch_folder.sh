#!/usr/bin/env bash
# Estimate the normals of every cloud in a folder. What is there already is left alone, so that an interrupted run goes on.
#
#     bash examples/02_batch_folder.sh SCANS RESULTS [OPTIONS OF jetnormal estimate]
set -euo pipefail

scans=$1 results=$2
shift 2
mkdir -p "$results"
for scan in "$scans"/*; do
    result=$results/$(basename "$scan")
    if [ -e "$result" ]; then
        continue
    fi
    jetnormal estimate "$scan" -o "$result" --quiet "$@" || echo "failed: $scan" >&2
done
