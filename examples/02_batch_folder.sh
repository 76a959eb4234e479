#!/usr/bin/env bash
# Estimate the normals of every cloud in a folder. What is there already is left alone, so that an interrupted run goes on;
# a file that fails does not stop the others.
#
#     bash examples/02_batch_folder.sh SCANS RESULTS [OPTIONS OF jetnormal estimate]
set -euo pipefail

scans=$1 results=$2
shift 2
jetnormal estimate "$scans"/* --out-dir "$results" --skip-existing "$@"
