"""A robot in another process: the swing-up pendulum, reached by a socket with delays.

The pendulum is that of `kreps/SwingUp-v0`, in continuous time.  Its clock does not wait for the
learner.  Every message takes 20 to 50 ms, at random, in either direction, and none overtakes
another.  Messages are lines of JSON:

- to the robot: ``{"reset": seed}`` brings it to rest, hanging; ``{"torque": 3.5}`` in N m holds
  until the next one arrives;
- from the robot: ``[tick, angle, velocity]`` in rad and rad/s, every 0.05 s from the first torque
  on.  Tick 0 is the answer to a reset.
"""

from __future__ import annotations

import argparse
import heapq
import json
import select
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from kreps.envs.integration import runge_kutta
from kreps.envs.swing_up import MAX_TORQUE, NOISE, TIME_STEP, acceleration, wrap_angle

DELAYS = 0.02, 0.05  # s, shortest and longest, each way


@dataclass(frozen=True)
class Clock:
    """Seconds that pass ``speed`` times as fast as those of the wall."""

    speed: float = 1.0

    def monotonic(self) -> float:
        return self.speed * time.monotonic()

    def sleep(self, seconds: float) -> None:
        time.sleep(seconds / self.speed)


@dataclass
class Pendulum:
    """The robot and what is on its way to and from it."""

    clock: Clock
    rng: np.random.Generator = field(default_factory=np.random.default_rng)
    state: Any = (np.pi, 0.0)
    torque: float = 0.0
    noise: float = 0.0
    tick: int = 0
    moved_until: float = 0.0
    events: list[tuple[float, int, str, Any]] = field(default_factory=list)
    arrivals: dict[str, float] = field(default_factory=dict)
    numbers: int = 0

    def at(self, moment: float, what: str, value: Any) -> None:
        """Let something happen at a moment; of two at the same, the one asked for first."""
        self.numbers += 1
        heapq.heappush(self.events, (moment, self.numbers, what, value))

    def delayed(self, now: float, what: str, value: Any) -> None:
        """Let a message that is sent now arrive, after those before it."""
        moment = max(now + self.rng.uniform(*DELAYS), self.arrivals.get(what, 0.0))
        self.arrivals[what] = moment
        self.at(moment, what, value)

    def move(self, until: float) -> None:
        if (duration := until - self.moved_until) > 0.0 and self.tick:
            steps = int(np.ceil(duration / 0.005))
            applied = self.torque + self.noise
            self.state = runge_kutta(
                lambda s: np.stack([s[1], acceleration(s[0], s[1], applied)]),
                np.array(self.state),
                duration,
                steps,
            )
        self.moved_until = until

    def happen(self, now: float, what: str, value: Any) -> Any:
        """What happens at a moment; returns a line to send, if one has arrived."""
        if what == "observation":
            return value
        self.move(now)
        if what == "tick" or "reset" in value:
            if what == "tick" and value != self.tick:
                return None  # of a rollout before the reset
            if what == "command":
                self.rng = np.random.default_rng(value["reset"])
                self.state, self.torque, self.tick = (np.pi, 0.0), 0.0, 0
            angle, velocity = float(wrap_angle(np.array(self.state[0]))), float(self.state[1])
            self.delayed(now, "observation", [self.tick, angle, velocity])
        else:
            self.torque = float(np.clip(value["torque"], -MAX_TORQUE, MAX_TORQUE))
        if what == "tick" or (self.tick == 0 and "torque" in value):
            self.noise = NOISE * self.rng.standard_normal()
            self.tick += 1
            self.at(now + TIME_STEP, "tick", self.tick)
        return None

    def serve(self, link: socket.socket) -> None:
        """Answer until the link is closed."""
        received = b""
        while True:
            while self.events and self.events[0][0] <= self.clock.monotonic():
                moment, _, what, value = heapq.heappop(self.events)
                if (line := self.happen(moment, what, value)) is not None:
                    link.sendall(json.dumps(line).encode() + b"\n")
            wait = None
            if self.events:
                wait = max(0.0, self.events[0][0] - self.clock.monotonic()) / self.clock.speed
            if select.select([link], [], [], wait)[0]:
                if not (new := link.recv(4096)):
                    return
                *lines, received = (received + new).split(b"\n")
                for line in lines:
                    self.delayed(self.clock.monotonic(), "command", json.loads(line))


@contextmanager
def started(speed: float = 1.0) -> Iterator[tuple[subprocess.Popen[str], socket.socket]]:
    """The robot in a process of its own, and a link to it, until the block ends."""
    command = [sys.executable, __file__, "--speed", str(speed)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            with socket.create_connection(("127.0.0.1", int(process.stdout.readline()))) as link:
                link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                yield process, link
        finally:
            process.kill()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--speed", type=float, default=1.0, help="simulated seconds per second")
    arguments = parser.parse_args()
    with socket.create_server(("127.0.0.1", 0)) as server:
        print(server.getsockname()[1], flush=True)
        connection, _ = server.accept()
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        Pendulum(Clock(arguments.speed)).serve(connection)
