"""Options of ``neuros launch`` that show the run."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from neuros.errors import UsageError
from neuros.options import Option
from neuros.ports import BackEnd, LaunchExtension, View

_PAGE = "../extensions/neuros-dashboard/README.md"


def _viewers() -> Iterable[str]:
    from neuros_dashboard.viewer import VIEWERS

    return VIEWERS


class _Views(LaunchExtension):
    options = (
        Option(
            ("--viewer",),
            is_repeatable=True,
            suggestions=_viewers,
            metavar="NAME",
            page=f"{_PAGE}#viewers",
            help="show the run with this viewer: dashboard, foxglove, rqt_graph, rviz2 or rerun;"
            " other Python packages may add viewers",
        ),
        Option(
            ("--dashboard",),
            default=False,
            page=_PAGE,
            help="print the address (on 127.0.0.1) of a page that shows the run in a browser:"
            " robots in 3-D, the graph, packets, images, logs, load; the page can pause, step and"
            " stop the run",
        ),
        Option(
            ("--dashboard-port",),
            parse=int,
            metavar="PORT",
            default_help="any free one",
            help="serve the dashboard on this port; implies --dashboard",
        ),
        Option(
            ("-g", "--node-graph"),
            default=False,
            page=f"{_PAGE}#rqt_graph-rviz-and-rerun",
            help="show the graph of the run: rqt_graph where it can run, else the dashboard",
        ),
        Option(
            ("-z", "--visualisations"),
            default=False,
            page=f"{_PAGE}#rqt_graph-rviz-and-rerun",
            help="show poses, images, scans and numbers: rviz2 where it can run, else Rerun in a"
            " browser (pip install 'neuros[rerun]')",
        ),
    )

    def prepare(
        self, options: Mapping[str, Any], back_end: BackEnd, *, is_isolated: bool
    ) -> View | None:
        subjects = {"--node-graph": "graph"} if options["node_graph"] else {}
        subjects |= {"--visualisations": "packets"} if options["visualisations"] else {}
        names, port = [*options["viewer"]], options["dashboard_port"]
        if is_isolated and (subjects or {*names} - {"dashboard", "foxglove"}):
            raise UsageError(
                "--isolate with -g, -z or --viewer: they cannot see into the run; use --dashboard"
                " or --viewer foxglove"
            )
        if options["dashboard"] or port is not None:
            names.append("dashboard")
        if not (names or subjects):
            return None
        from neuros_dashboard.viewer import Views

        return Views(back_end, names, subjects, port)


VIEWS = _Views()
