"""The load now: what was used since somebody last looked."""

from __future__ import annotations

from neuros.observe.load import GroupLoad, MachineLoad
from neuros.observe.load_now import LoadNow


class Meter:
    cpu_s = 10.0

    def machine(self) -> MachineLoad:
        return MachineLoad((50.0, 20.0), 3_000, 40.0, 1, 2)

    def groups(self) -> dict[str, GroupLoad]:
        return {"robot": GroupLoad(self.cpu_s, 500, 7)}


def test_processor_time_is_that_since_the_last_look() -> None:
    now_s = [0.0]
    meter = Meter()
    load_now = LoadNow(meter, lambda: now_s[0])
    now_s[0] = 1.0
    assert load_now()["groups"]["robot"]["cpu_percent"] == 0.0
    now_s[0], meter.cpu_s = 3.0, 11.0
    shown = load_now()
    assert shown["groups"]["robot"] == {"cpu_percent": 50.0, "memory_bytes": 500, "threads": 7}
    assert shown["cores"] == [50.0, 20.0]
