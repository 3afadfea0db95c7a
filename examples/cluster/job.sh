#!/bin/sh
# sbatch -N NODES job.sh PROGRAM [ARGUMENT...]
# One rank on each node, with all of its processors. Options of sbatch win over these lines; MPI=pmix in the environment is
# for Open MPI, the default for MPICH.
#SBATCH --job-name=dfb
#SBATCH --ntasks-per-node=1
#SBATCH --exclusive
#SBATCH --time=10
set -eu
exec srun --mpi="${MPI:-pmi2}" --cpu-bind=none --kill-on-bad-exit=0 "$@"
