"""Proof that packets arrive: a project of two nodes, run as any other.

That nodes see each other's topics proves nothing: shared memory that is not shared loses every
packet without a word. So one node sends images, the other answers with what it has read in them.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from neuros.doctor.machine_checks import Finding, bad, good
from neuros.recording.run_file import read_run_file

PROJECT = Path(__file__).with_name("delivery")
_TIMEOUT_S = 60.0


def prove_delivery(backend: str, project: Path = PROJECT) -> Finding:
    """Run the project on a back end; it ends by itself when all images have come back."""
    subject = "delivery"
    with tempfile.TemporaryDirectory(prefix="neuros-doctor-") as folder:
        run = Path(folder) / "run"
        command = [sys.executable, "-m", "neuros.cli", "launch", str(project)]
        command += ["--backend", backend, "-o", str(run)]
        with subprocess.Popen(
            command,
            cwd=folder,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        ) as launcher:
            try:
                output, _ = launcher.communicate(timeout=_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                launcher.terminate()
                output, _ = launcher.communicate()
                return bad(subject, f"{backend}: no end after {_TIMEOUT_S:g} s", _last(output))
            except BaseException:
                launcher.terminate()
                raise
        if launcher.returncode:
            return bad(subject, f"{backend}: failed", _last(output))
        return _judge(backend, read_run_file(run))


def _judge(backend: str, record: dict[str, object]) -> Finding:
    connections = record["connections"]
    assert isinstance(connections, list)
    counts = [f"{c['consumed']} of {c['sent']} on {c['connection']}" for c in connections]
    is_whole = all(c["sent"] and c["consumed"] == c["sent"] for c in connections)
    text = f"{backend}: packets arrived: {', '.join(counts)}"
    return (good if is_whole else bad)("delivery", text)


def _last(output: str) -> str:
    """What the launcher has said last, which is why it ended."""
    rows = [row for row in output.splitlines() if row.strip()]
    return rows[-1] if rows else "it said nothing"
