#!/bin/sh
# sbatch -N NODES job.sh PROGRAM [ARGUMENT...]
# Runs one rank on each node, with all of its processors. Options of sbatch override the lines below. The default is for
# MPICH; set MPI=pmix in the environment for Open MPI.
#SBATCH --job-name=dfb
#SBATCH --ntasks-per-node=1
#SBATCH --exclusive
#SBATCH --time=10
set -eu
exec srun --mpi="${MPI:-pmi2}" --cpu-bind=none --kill-on-bad-exit=0 "$@"
