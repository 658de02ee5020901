"""Batch scripts for Slurm: a project on the nodes of one allocation."""

from __future__ import annotations

import json
import os
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from neuros.api.request import ExportOptions
from neuros.errors import UsageError
from neuros.executors.executor import JobResources
from neuros.project.load import PROJECT_FILE
from neuros.project.model import Project
from neuros.project.suggest import did_you_mean

_SCRIPT = """\
#!/bin/sh
#SBATCH --job-name={name}
#SBATCH --nodes={count}
#SBATCH --ntasks-per-node=1
#SBATCH --output={name}-%j.log
{resources}\
# Submit it with sbatch. The launcher runs on the first node of the allocation, and so do the nodes
# of the project that the deployment does not name; agents run the others.
if [ "${{SLURM_JOB_NUM_NODES:-0}}" -lt {count} ]; then
    echo "this needs a Slurm allocation of {count} node(s): submit it with sbatch" >&2
    exit 4
fi
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
_MEBIBYTE = 1 << 20


def script_of(project: Project, options: ExportOptions) -> str:
    """The script for a checked project, with the resources that its nodes declare.

    Raises:
        UsageError: if a node is placed that the project lacks.
    """
    names = [node.name for node in project.nodes]
    places = {name: number for number, name in enumerate(names)} if options.spread else {}
    for name, number in options.place:
        if name not in names:
            hint = did_you_mean(name, names) or f"it has {', '.join(names)}"
            raise UsageError(f"--place {name}={number}: the project has no such node; {hint}")
        places[name] = number
    on_each = [
        tuple(node for node in project.nodes if places.get(node.name, 0) == number)
        for number in range(max(places.values(), default=0) + 1)
    ]
    beside = Path(sys.executable).with_name("neuros")
    changes = options.set or ()
    if isinstance(changes, Mapping):
        changes = [f"{path}={json.dumps(value)}" for path, value in changes.items()]
    given: list[tuple[str, object]] = [("-d", options.domain_id), ("--duration", options.duration)]
    given += [("--namespace", options.namespace), *(("--set", each) for each in changes)]
    given += [("--remap", each) for each in options.remap or ()]
    return slurm_script(
        project.file if project.file.name != PROJECT_FILE else project.folder,
        places,
        neuros=str(beside) if beside.exists() else "neuros",
        options=[part for flag, value in given if value is not None for part in (flag, str(value))],
        resources=JobResources.most(
            JobResources.of(replace(project, nodes=nodes)) for nodes in on_each
        ),
    )


def slurm_script(
    project: str | os.PathLike[str],
    places: Mapping[str, int],
    *,
    neuros: str = "neuros",
    options: Sequence[str] = (),
    resources: JobResources | None = None,
) -> str:
    """A script for ``sbatch`` that runs a project on the nodes of its allocation.

    Args:
        project: the project, as the first node of the allocation sees it.
        places: by node of the project, the number of the cluster's node in the allocation, from 0;
            what is not named runs beside the launcher, on number 0.
        neuros: the command ``neuros`` on all of them.
        options: further ones of ``neuros launch``.
        resources: what each of them has to have.
    """
    elsewhere = {node: number for node, number in places.items() if number}
    numbers = sorted({*elsewhere.values()})
    hosts = {
        f"node{number}": {"through": [*_STEP, f"--relative={number}"], "neuros": neuros}
        for number in numbers
    }
    nodes = {node: f"node{number}" for node, number in elsewhere.items()}
    name = os.path.basename(os.path.abspath(project)).removesuffix(".json")
    return _SCRIPT.format(
        name=name,
        count=max(numbers, default=0) + 1,
        resources="".join(f"#SBATCH {line}\n" for line in _lines(resources or JobResources())),
        deployment=json.dumps({"hosts": hosts, "nodes": nodes}, indent=2),
        command=shlex.join([neuros, "launch", os.fspath(project), *options]),
    )


def _lines(needs: JobResources) -> list[str]:
    return [
        *([f"--cpus-per-task={needs.cpus}"] if needs.cpus else []),
        *([f"--mem={-(-needs.mem_bytes // _MEBIBYTE)}M"] if needs.mem_bytes else []),
        *([f"--gpus-per-node={needs.gpus}"] if needs.gpus else []),
    ]
