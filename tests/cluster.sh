#!/bin/sh
# sh tests/cluster.sh [--root FOLDER] [--output FOLDER] [--help]
# Does what examples/cluster/dfb.def says, %files, %post and %test, in a new Debian system; then installs Slurm there, as one
# node, and gives it examples/cluster/job.sh with the program that was built: the picture of 3 ranks must be that of MPICH's
# own launcher. The steps are read from dfb.def, so both are always the same.
#   --root FOLDER    the system to begin with; made if it is not there, 200 MB, and copied for each run.
#                    Default: build/cluster-root
#   --output FOLDER  for the logs. Default: build/cluster
# Exits with 0 if all works; with 77 if it cannot run here: it needs root, and Debian or a system made of it.
set -eu

script=cluster.sh
source=$(CDPATH='' cd -- "$(dirname -- "$0")/.." && pwd)
root=$source/build/cluster-root
output=$source/build/cluster
# shellcheck source=tests/support/debian_root.sh
. "$source/tests/support/debian_root.sh"

read_options "$@"
isolate "$@"
mkdir -p "$output"
[ -e "$root/etc/debian_version" ] || make_root
rm -rf --one-file-system "$root.run"
cp -a "$root" "$root.run"
root=$root.run
enter_root

# section NAME: prints that section of dfb.def
section() {
    awk -v name="%$1" '/^%/ { on = $1 == name; next } on' "$source/examples/cluster/dfb.def"
}

# step NAME: runs that section in the system as Apptainer does: with sh, up to the first error.
step() {
    say "%$1 of dfb.def"
    section "$1" >"$root/tmp/step"
    [ -s "$root/tmp/step" ] || give_up "dfb.def has no %$1"
    in_root sh -ex /tmp/step >"$output/$1.log" 2>&1 || give_up "FAILED: %$1: see $output/$1.log"
}

rm -rf --one-file-system "$root/dfb"
section files | while read -r from to; do
    [ -z "$from" ] || { mkdir -p "$root$(dirname "$to")" && cp -rL "$source/$from" "$root$to"; } || exit 1
done || give_up "FAILED: %files of dfb.def"
step post
step test

install_there mpich slurm-wlm munge
name=$(hostname)
mkdir -p "$root/etc/slurm" "$root/var/spool/slurm" "$root/var/log/slurm" "$root/run/munge" "$root/scratch"
cat >"$root/etc/slurm/slurm.conf" <<END
ClusterName=dfb
SlurmctldHost=$name(127.0.0.1)
SlurmUser=root
SlurmctldPort=36817
SlurmdPort=36818
AuthType=auth/munge
StateSaveLocation=/var/spool/slurm
SlurmdSpoolDir=/var/spool/slurm/slurmd
SlurmctldLogFile=/var/log/slurm/slurmctld.log
SlurmdLogFile=/var/log/slurm/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
ReturnToService=2
SlurmdParameters=config_overrides
NodeName=$name NodeAddr=127.0.0.1 CPUs=4 State=UNKNOWN
PartitionName=all Nodes=ALL Default=YES State=UP
END
in_root chown munge: /run/munge
in_root runuser -u munge -- munged || give_up "munge does not start"
in_root slurmctld || give_up "slurmctld does not start: see $root/var/log/slurm"
in_root slurmd || give_up "slurmd does not start: see $root/var/log/slurm"
say "Slurm $(in_root sinfo --version | sed 's/.* //'): job.sh with 3 ranks"
mkdir "$root/scratch/slurm" "$root/scratch/mpiexec"
# shellcheck disable=SC2016 # expands there
if ! in_root timeout 120 sh -c 'cd /scratch/slurm && sbatch --wait --ntasks-per-node=3 -o job.log /dfb/examples/cluster/job.sh minimal' ||
    ! [ -s "$root/scratch/slurm/minimal.ppm" ]; then
    cp -r "$root/var/log/slurm" "$output"
    [ ! -e "$root/scratch/slurm/job.log" ] || cat "$root/scratch/slurm/job.log"
    give_up "FAILED: the job; logs of Slurm are in $output/slurm"
fi
in_root sh -c "cd /scratch/mpiexec && timeout 60 mpiexec -n 3 minimal" || give_up "FAILED: minimal on 3 ranks of mpiexec"
cmp "$root/scratch/slurm/minimal.ppm" "$root/scratch/mpiexec/minimal.ppm" ||
    give_up "FAILED: the picture of 3 ranks under Slurm is not that of 3 ranks under mpiexec"
say "passed"
