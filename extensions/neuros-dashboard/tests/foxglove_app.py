"""An app of Foxglove, as its server sees one: the protocol ``foxglove.sdk.v1`` over WebSocket."""

from __future__ import annotations

import contextlib
import json
import struct
import time
from collections.abc import Iterator, Mapping
from typing import Any

from websockets.sync.client import ClientConnection, connect

DEADLINE_S = 60
_MESSAGE, _CALL, _ANSWER = 1, 2, 3


class App:
    """A connected app.

    Attributes:
        channels: what the server offers, by topic.
        services: by name.
        statuses: what it says to users.
        times_ns: of all messages so far.
    """

    def __init__(self, socket: ClientConnection) -> None:
        self._socket = socket
        self.channels: dict[str, Mapping[str, Any]] = {}
        self.services: dict[str, Mapping[str, Any]] = {}
        self.statuses: list[str] = []
        self.times_ns: list[int] = []
        self._topics: dict[int, str] = {}
        self.messages: list[tuple[str, bytes]] = []
        self.answers: list[Any] = []

    def receive(self) -> None:
        """Take in one message of the server. Raises ``TimeoutError``."""
        data = self._socket.recv(timeout=DEADLINE_S)
        if isinstance(data, bytes):
            if data[0] == _MESSAGE:
                subscription, time_ns = struct.unpack_from("<IQ", data, 1)
                self.times_ns.append(time_ns)
                self.messages.append((self._topics[subscription], data[13:]))
            elif data[0] == _ANSWER:
                self.answers.append(json.loads(data[13 + len("json") :]))
            return
        told = json.loads(data)
        match told["op"]:
            case "advertise":
                self.channels |= {each["topic"]: each for each in told["channels"]}
            case "advertiseServices":
                self.services |= {each["name"]: each for each in told["services"]}
            case "status":
                self.statuses.append(told["message"])
            case "serviceCallFailure":
                self.answers.append(told["message"])

    def subscribe(self, topic: str) -> None:
        number = len(self._topics) + 1
        self._topics[number] = topic
        wanted = {"id": number, "channelId": self.channels[topic]["id"]}
        self._send({"op": "subscribe", "subscriptions": [wanted]})

    def unsubscribe(self) -> None:
        self._send({"op": "unsubscribe", "subscriptionIds": [*self._topics]})
        self.messages.clear()

    def next(self, topic: str) -> bytes:
        """The next message of a topic."""
        give_up_s = time.monotonic() + DEADLINE_S
        while time.monotonic() < give_up_s:
            for place, (of, data) in enumerate(self.messages):
                if of == topic:
                    del self.messages[place]
                    return data
            self.receive()
        raise AssertionError(f"nothing came on {topic}")

    def call(self, service: str, request: Any) -> Any:
        """The answer of a service, or the text of its failure."""
        number = self.services[service]["id"]
        head = struct.pack("<BIII", _CALL, number, 1, len("json"))
        self._socket.send(head + b"json" + json.dumps(request).encode())
        while not self.answers:
            self.receive()
        return self.answers.pop(0)

    def _send(self, told: Mapping[str, Any]) -> None:
        self._socket.send(json.dumps(told))


@contextlib.contextmanager
def app(url: str) -> Iterator[App]:
    """An app that has heard what the server of a run offers."""
    give_up_s = time.monotonic() + DEADLINE_S
    while True:  # the server starts beside the run
        try:
            socket = connect(url, subprotocols=["foxglove.sdk.v1"], max_size=None)  # type: ignore[list-item]
            break
        except ConnectionRefusedError:
            assert time.monotonic() < give_up_s, "no server came"
            time.sleep(0.05)
    with socket:
        connected = App(socket)
        while not connected.services:
            connected.receive()
        yield connected
