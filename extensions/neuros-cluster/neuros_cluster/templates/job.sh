#!/bin/sh
#SBATCH --job-name=@name@
#SBATCH --nodes=@count@
#SBATCH --ntasks-per-node=1
#SBATCH --output=@name@-%j.log
@resources@# Submit it with sbatch. The launcher runs on the first node of the allocation, and so do the nodes
# of the project that the deployment does not name; agents run the others.
if [ "${SLURM_JOB_NUM_NODES:-0}" -lt @count@ ]; then
    echo "this needs a Slurm allocation of @count@ node(s): submit it with sbatch" >&2
    exit 4
fi
deployment=$(mktemp --suffix=.json) || exit 4
trap 'rm -f "$deployment"' EXIT
trap 'kill -TERM "$launcher"' TERM
cat >"$deployment" <<'END'
@deployment@
END
@command@ --deployment "$deployment" "$@" &
launcher=$!
wait "$launcher"
code=$?
# A signal ends the first wait, and not the launcher.
while kill -0 "$launcher" 2>/dev/null; do wait "$launcher"; code=$?; done
exit "$code"
