"""Reports, charts and comparisons of runs, frames of recorded packets, and sweeps of many runs."""

from neuros.ports import Subcommand

REPORT = Subcommand(
    "neuros_analysis.command", "say what limited the speed of a run, and draw figures"
)
COMPARE = Subcommand("neuros_analysis.command", "show the numbers of several runs side by side")
SWEEP = Subcommand(
    "neuros_analysis.command", "run a project with many values and seeds, and make one table"
)
