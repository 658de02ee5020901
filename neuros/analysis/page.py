"""HTML page of a run: one file with its tables and figures, without scripts or network."""

from __future__ import annotations

import base64
import io
import shlex
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime, timezone
from html import escape
from string import Template
from typing import Any

from neuros.analysis.charts import (
    counts_figure,
    graph_figure,
    latency_figure,
    load_figure,
    ticks_figure,
    time_budget_figure,
    time_figure,
    timeline_figure,
)
from neuros.analysis.findings import Findings
from neuros.analysis.run_record import PastRun
from neuros.backends.registered import back_end_of

_PAGE = Template("""\
<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width">
<title>$title</title>
<style>
body { font: 16px/1.5 system-ui, sans-serif; color: #222; max-width: 68rem; margin: 2rem auto;
       padding: 0 1rem }
h1 { font-size: 1.6rem } h2 { font-size: 1.15rem; margin-top: 2.2rem }
.main { border-left: 6px solid #D55E00; background: #FBF3EC; padding: .6rem 1.2rem }
.main p:first-of-type { font-size: 1.15rem; font-weight: 600 }
.missing { border-left: 6px solid #999; background: #F5F5F5; padding: .4rem 1.2rem }
img { max-width: 100%; height: auto }
.table { overflow-x: auto }
table { border-collapse: collapse; font-size: .88rem }
th, td { padding: .25rem .7rem; text-align: right; border-bottom: 1px solid #DDD }
th:first-child, td:first-child, .text td { text-align: left }
code { background: #F0F0F0; padding: .1rem .3rem; overflow-wrap: anywhere }
</style>
</head>
<body>
<h1>$title</h1>
$body
</body>
</html>
""")


def png(figure: Any) -> bytes:
    """A figure as a file's content."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


def report_page(run: PastRun, findings: Findings, figures: Mapping[str, tuple[str, bytes]]) -> str:
    """The page of a run.

    Args:
        figures: by title, what is seen on each in a sentence, and its PNG.
    """
    parts = [_facts(run), bottleneck_part(findings)]
    if run.missing:
        parts.append(_missing(run.missing))
    parts += [figure_part(title, text, data) for title, (text, data) in figures.items()]
    parts += [_connections(run), _provenance(run)]
    return page(f"Run of {run.name}", parts)


def page(title: str, parts: Sequence[str]) -> str:
    """A page of ready-made parts."""
    return _PAGE.substitute(title=escape(title), body="\n".join(parts))


def bottleneck_part(findings: Findings, title: str = "The bottleneck") -> str:
    """The findings under a heading."""
    lines = [f"<p>{escape(findings.headline)}</p>"]
    if findings.reasons:
        items = "".join(f"<li>{escape(reason)}</li>" for reason in findings.reasons)
        lines.append(f"<ul>{items}</ul>")
    lines += [f"<p>{escape(gain)}</p>" for gain in findings.gains]
    if findings.trial:
        lines.append(f"<p>To test it: <code>{escape(findings.trial)}</code></p>")
    return f'<h2>{escape(title)}</h2>\n<div class="main">{"".join(lines)}</div>'


def table_part(
    title: str, header: Sequence[str], rows: Sequence[Sequence[str]], kind: str = "numbers"
) -> str:
    """A table under a heading; aligned for its ``kind``, ``numbers`` or ``text``."""
    head = "".join(f"<th>{escape(cell)}</th>" for cell in header)
    body = "".join(
        f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in rows
    )
    return (
        f'<h2>{escape(title)}</h2>\n<div class="table {kind}"><table><thead><tr>{head}</tr></thead>'
        f"<tbody>{body}</tbody></table></div>"
    )


def figure_part(title: str, text: str, data: bytes) -> str:
    """A figure under a heading, in the page itself."""
    uri = f"data:image/png;base64,{base64.b64encode(data).decode('ascii')}"
    return (
        f'<h2>{escape(title)}</h2>\n<p>{escape(text)}</p>\n<img alt="{escape(title)}" src="{uri}">'
    )


def _facts(run: PastRun) -> str:
    record = run.record
    parts = [str(record.get("reason") or "ended normally")]
    if record.get("sim_s") is not None:
        parts.append(f"{record['sim_s']:.2f} s of simulated time")
    if record.get("wall_s") is not None:
        parts.append(f"{record['wall_s']:.2f} s of wall time")
    if record.get("real_time_factor"):
        parts.append(f"real-time factor {record['real_time_factor']:.2f}")
    parts += [f"broken budget: {each}" for each in record.get("broken_budgets", ())]
    return f"<p>{escape('; '.join(parts))}.</p>"


def _missing(missing: Sequence[str]) -> str:
    items = "".join(f"<li>{escape(each)}</li>" for each in missing)
    return f'<div class="missing"><p>What this page lacks:</p><ul>{items}</ul></div>'


def _connections(run: PastRun) -> str:
    header = ["connection", "sent", "received", "consumed", "discarded", "lost",
              "longest discard", "rate / Hz", "median / ms", "99 % / ms", "max / ms"]  # fmt: skip
    counts = ("sent", "received", "consumed", "discarded", "lost", "longest_discard")
    rows = []
    for name, figures in run.connections.items():
        latency = figures.get("latency_ms") or {}
        rows.append(
            [
                name,
                *("?" if figures.get(key) is None else f"{figures[key]:,}" for key in counts),
                _number(figures.get("rate_hz"), 1),
                *(_number(latency.get(key), 2) for key in ("p50", "p99", "max")),
            ]
        )
    return table_part("Packets and latencies", header, rows)


def _number(value: float | None, digits: int) -> str:
    return "?" if value is None else f"{value:,.{digits}f}"


def _provenance(run: PastRun) -> str:
    record = run.record
    machine, versions = record.get("machine") or {}, record.get("versions") or {}
    git = record.get("git") or {}
    back_end = back_end_of(record)
    started = record.get("started")
    when = datetime.fromtimestamp(started, timezone.utc) if started else None
    cells = {
        "folder": run.folder,
        "project": record.get("file"),
        "started": when and when.strftime("%Y-%m-%d %H:%M:%S UTC"),
        "back end": record.get("backend"),
        "machine": machine and _machine(machine),
        "NeuROS, Python": versions and f"{versions.get('neuros')}, {versions.get('python')}",
        "git": git and f"{git.get('commit')}{' (changed)' if git.get('is_dirty') else ''}",
        **(back_end.provenance(record) if back_end else {}),
        "seeds": ", ".join(
            f"{node}: {name} {value}"
            for node, found in (record.get("seeds") or {}).items()
            for name, value in found.items()
        ),
        "command": shlex.join(record.get("command", ())),
    }
    rows = [[key, str(value)] for key, value in cells.items() if value]
    return table_part("Where it comes from", ["", ""], rows, "text")


def _machine(machine: Mapping[str, Any]) -> str:
    memory = f"{machine['memory_bytes'] / 1e9:.1f} GB" if "memory_bytes" in machine else None
    cores = f"{machine['cores']} cores" if "cores" in machine else None
    parts = [machine.get("processor"), cores, memory, machine.get("system")]
    return ", ".join(str(part) for part in parts if part)


_FIGURES: tuple[tuple[str, str, str, Callable[[PastRun], Any]], ...] = (
    (
        "graph",
        "Nodes and connections",
        "Each node with its busiest hook and how it spent its time; each connection with its"
        " guarantee, what it carried and lost, and how long a packet waited for a hook (median).",
        graph_figure,
    ),
    (
        "time_shares",
        "Where the time went",
        "Shares of each node's time, without the start and the end of the run; what is missing to"
        " 100 % is scheduling: a hook whose turn has not come.",
        time_budget_figure,
    ),
    (
        "swim_lanes",
        "Who waits for whom",
        "Hooks as bars, packets from their sender to the start of a hook on them, and"
        " acknowledgements back.",
        timeline_figure,
    ),
    (
        "real_time",
        "Simulated against real time",
        "One point per simulated second; wall time from the first hook on.",
        time_figure,
    ),
    (
        "packets",
        "Packets",
        "What became of the packets of each connection.",
        counts_figure,
    ),
    (
        "latency",
        "Latency",
        "The share of packets on which a hook had started within a time after they were sent.",
        latency_figure,
    ),
    (
        "ticks",
        "Regularity of timed hooks",
        "Intervals between the starts of a hook with a period.",
        ticks_figure,
    ),
    (
        "system_load",
        "Processor and memory",
        "Of each node's processes, once per second from the command on; 100 % is one core.",
        load_figure,
    ),
)


def figures_of(run: PastRun) -> dict[str, tuple[str, str, bytes]]:
    """By file name (without ending): title, what is seen, PNG; only what says something."""
    found = {}
    for name, title, text, draw in _FIGURES:
        figure = draw(run)
        if figure is not None:
            found[name] = (title, text, png(figure))
    return found
