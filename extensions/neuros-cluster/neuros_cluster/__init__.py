"""Runs on other machines: by ssh, on Slurm, Dask and Kubernetes, in Compose and Apptainer."""

from neuros.ports import Subcommand

EXPORT = Subcommand(
    "neuros_cluster.command", "write a project as files for Docker Compose or Kubernetes"
)
PART = Subcommand("neuros_cluster.part")
AGENT = Subcommand("neuros_cluster.agent")
