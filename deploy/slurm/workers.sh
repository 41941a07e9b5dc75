#!/bin/bash
# Workers of a service: sbatch --array=1-20 workers.sh
# Each worker ends when no job has waited for a minute; submit the array again when there are new jobs. At the time limit
# Slurm sends SIGTERM: the worker hands its job back, and another worker starts it again.
#SBATCH --job-name=heliopsf-worker
#SBATCH --cpus-per-task=8
#SBATCH --mem=16G
#SBATCH --time=12:00:00
#SBATCH --signal=B:TERM@60
set -euo pipefail
. "${HELIOPSF_ENV:-$HOME/heliopsf.env}"  # exports HELIOPSF_DATABASE_URL, HELIOPSF_BROKER_URL and HELIOPSF_DATA_DIR
export HELIOPSF_WORKER_THREADS=$SLURM_CPUS_PER_TASK
exec heliopsf worker --until-idle 60
