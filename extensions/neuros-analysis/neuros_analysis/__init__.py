"""Reports, timing, comparisons, replays and forks of runs, frames of packets, and sweeps."""

from neuros.ports import Subcommand

REPORT = Subcommand(
    "neuros_analysis.command", "say what limited the speed of a run, and draw figures"
)
COMPARE = Subcommand("neuros_analysis.command", "show the numbers of several runs side by side")
TIMING = Subcommand(
    "neuros_analysis.timing_command",
    "measure durations of hooks and delays of connections in a run",
)
SWEEP = Subcommand(
    "neuros_analysis.command", "run a project with many values and seeds, and make one table"
)
REPLAY = Subcommand(
    "neuros_analysis.replay.command",
    "run one node of a recorded run again, or publish recorded topics",
)
REPLAYED = Subcommand("neuros_analysis.replay.command")
FORK = Subcommand(
    "neuros_analysis.fork_command",
    "run a past run again up to a moment, then go on with a change",
)
