"""The small examples do what their READMEs say; as processes, test_gallery.py runs them too."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

from launching import EXAMPLES, each_time, launch

TENNIS = EXAMPLES / "2_synchronisation/tennis"
VOTING = EXAMPLES / "2_synchronisation/voting"

pytestmark = each_time("in-process")


def test_the_length_of_a_rally_can_be_set(backend: str, tmp_path: Path) -> None:
    setting = "nodes.ann.environment.RALLY=4"
    run = launch(TENNIS, "--backend", backend, "--set", setting, cwd=tmp_path)
    assert run.exit_code == 0, run.output
    assert run.said("bob") == ["stroke 2", "stroke 4"]


def test_all_votes_are_counted(backend: str, tmp_path: Path) -> None:
    run = launch(VOTING, "--backend", backend, cwd=tmp_path)
    assert run.exit_code == 0, run.output
    questions = [text for text in run.said("chair") if text.endswith("?")]
    assert questions == ["apples or pears?", "tea or coffee?", "cats or dogs?"]
    results = [text for text in run.said("chair") if " for " in text]
    votes = {name: run.said(name) for name in ("ann", "bob", "cleo")}
    for index, result in enumerate(results):
        cast = [given[index] for given in votes.values()]
        assert all(f"{cast.count(choice)} for {choice}" in result for choice in cast)
    assert len(results) == 3
    assert len(run.record["connections"]) == 6
    assert all(c["consumed"] == c["sent"] == 3 for c in run.record["connections"])


def test_a_voter_more_is_a_matter_of_the_project_file(backend: str, tmp_path: Path) -> None:
    for plugin in ("chair.py", "voter.py"):
        shutil.copy(VOTING / plugin, tmp_path)
    project = json.loads((VOTING / "project.json").read_text())
    voter = project["nodes"][-1]
    last_two = project["connections"][-2:]
    project["nodes"].append({**voter, "name": "dan"})
    project["connections"] += json.loads(json.dumps(last_two).replace(voter["name"], "dan"))
    (tmp_path / "four.json").write_text(json.dumps(project))

    run = launch("four.json", "--backend", backend, cwd=tmp_path)
    assert run.exit_code == 0, run.output
    results = [text.split(":")[0] for text in run.said("chair") if " for " in text]
    totals = [sum(int(part.split(" for ")[0]) for part in text.split(", ")) for text in results]
    assert totals == [4, 4, 4]
