"""Batch scripts for Slurm: a project on the nodes of one allocation."""

from __future__ import annotations

import json
import os
import shlex
from collections.abc import Mapping, Sequence

_SCRIPT = """\
#!/bin/sh
#SBATCH --job-name={name}
#SBATCH --nodes={count}
#SBATCH --ntasks-per-node=1
#SBATCH --output={name}-%j.log
# Submit it with sbatch. It runs on the first node of the allocation, and so do the nodes of the
# project that the deployment does not name; agents run the others.
deployment=$(mktemp --suffix=.json) || exit 4
trap 'rm -f "$deployment"' EXIT
trap 'kill -TERM "$launcher"' TERM
cat >"$deployment" <<'END'
{deployment}
END
{command} --deployment "$deployment" "$@" &
launcher=$!
wait "$launcher"
code=$?
# A signal ends the first wait, and not the launcher.
while kill -0 "$launcher" 2>/dev/null; do wait "$launcher"; code=$?; done
exit "$code"
"""
# The steps share what the job has with the batch step, where the launcher is.
_STEP = ("srun", "--overlap", "--mem=0", "--nodes=1", "--ntasks=1", "--mpi=none")


def slurm_script(
    project: str | os.PathLike[str],
    places: Mapping[str, int],
    *,
    neuros: str = "neuros",
    options: Sequence[str] = (),
) -> str:
    """A script for ``sbatch`` that runs a project on the nodes of its allocation.

    Args:
        project: the project, as the first node of the allocation sees it.
        places: by node of the project, the number of the cluster's node in the allocation, from 0;
            what is not named runs beside the launcher, on number 0.
        neuros: the command ``neuros`` on all of them.
        options: further ones of ``neuros launch``.
    """
    numbers = sorted({*places.values()})
    hosts = {
        f"node{number}": {"through": [*_STEP, f"--relative={number}"], "neuros": neuros}
        for number in numbers
    }
    nodes = {node: f"node{number}" for node, number in places.items()}
    name = os.path.basename(os.path.abspath(project)).removesuffix(".json")
    return _SCRIPT.format(
        name=name,
        count=max([0, *numbers]) + 1,
        deployment=json.dumps({"hosts": hosts, "nodes": nodes}, indent=2),
        command=shlex.join([neuros, "launch", os.fspath(project), *options]),
    )
