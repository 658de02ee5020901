"""A viewer of another distribution: it notes in a file what run it was given, and that it ended."""

from __future__ import annotations

from pathlib import Path

from neuros.ports import BackEnd, Guardian
from neuros.viewers.viewer import Shown, Viewer


class Note:
    """Of one run."""

    path = Path("/nowhere")

    def start(self, run: Shown, guardian: Guardian) -> str:
        self.path = run.folder / "note.txt"
        self.path.write_text(f"{run.project.name}: {', '.join(run.names)}\n")
        return f"notes: {self.path}"

    def finish(self) -> None:
        with self.path.open("a") as file:
            file.write("ended\n")


class Notes(Viewer):
    """Needs nothing of this machine."""

    name = "notes"
    place = "a note"

    def prepare(self, back_end: BackEnd, subject: str | None, port: int | None) -> Note:
        return Note()


VIEWER = Notes()
