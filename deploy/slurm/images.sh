#!/bin/bash
# Images without a service and without internet: sbatch --array=0-19 images.sh INPUT-FOLDER OUTPUT-FOLDER
# Each task deconvolves its share of the images. Images whose product is there are skipped, so the array may be submitted again.
# The PSFs come from HELIOPSF_CACHE_DIR, a folder that all nodes see; fill it first, on one node:
#     heliopsf deconvolve ONE-IMAGE-OF-EACH-CHANNEL... -o OUTPUT-FOLDER/ --local
#SBATCH --job-name=heliopsf-images
#SBATCH --cpus-per-task=4
#SBATCH --mem=8G
#SBATCH --time=12:00:00
set -euo pipefail
export HELIOPSF_CACHE_DIR=${HELIOPSF_CACHE_DIR:-$HOME/.cache/heliopsf} OMP_NUM_THREADS=$SLURM_CPUS_PER_TASK
images=("$1"/*.fits) mine=()
for ((n = SLURM_ARRAY_TASK_ID - SLURM_ARRAY_TASK_MIN; n < ${#images[@]}; n += SLURM_ARRAY_TASK_COUNT)); do
    mine+=("${images[n]}")
done
[ ${#mine[@]} -eq 0 ] || exec heliopsf deconvolve "${mine[@]}" -o "$2/" --local
