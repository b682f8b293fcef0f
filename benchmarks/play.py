"""The window and the 20 Hz loop in lockstep: pictures per second, lateness, processor time.

    python -m benchmarks.play [--seconds 20] [--json F]

The window is SDL's dummy one, keys come through its queue. The shipped policy drives the simulated
machine.
"""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from benchmarks import POLICY, write
from benchmarks.bus import percentiles
from brokk_min.can.drive_log import Telemetry
from brokk_min.learning.policy import PolicyController, load_policy
from brokk_min.machine import BROKK_170
from brokk_min.viewer import play
from brokk_min.viewer.control_process import BusOptions
from brokk_min.viewer.input_handler import InputHandler


@dataclass
class Options:
    seconds: float = 20.0  # How long to drive [s].
    json: Path | None = None  # Also write the figures here.


class Player:
    """Holds the switch once the gate is ready, changes direction every second, and keeps times."""

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds
        self.start = 0.0  # s, when it first drove
        self.processor = 0.0  # s of processor time until then
        self.keys = set[str]()
        self.times: list[float] = []  # s, of pictures
        self.telemetry: dict[float, Telemetry] = {}  # by tick

    def __call__(self, session: play.Session, handler: InputHandler) -> bool:
        """One picture; False at the end."""
        now = time.monotonic()
        telemetry = session.telemetry
        if telemetry is None:
            return True
        keys = set[str]()
        if telemetry.driving or not telemetry.active_fault:
            keys.add("space")
        if telemetry.driving and not self.start:
            self.start = now
            self.processor = time.process_time()
        if self.start:
            self.times.append(now)
            self.telemetry[telemetry.tick] = telemetry
            keys.add(("left", "w", "right", "s")[int(now) % 4])
        pygame = handler.pygame
        for name in self.keys ^ keys:
            kind = pygame.KEYDOWN if name in keys else pygame.KEYUP
            pygame.event.post(pygame.event.Event(kind, key=pygame.key.key_code(name)))
        self.keys = keys
        return not self.start or now - self.start < self.seconds

    def figures(self) -> dict[str, Any]:
        """Pictures per second and times in ms."""
        periods = 1e3 * np.diff(self.times)
        processor = 1e3 * (time.process_time() - self.processor) / len(periods)
        ticks = sorted(self.telemetry)
        late = [1e3 * self.telemetry[tick].lateness for tick in ticks]
        driving = [telemetry.driving for telemetry in self.telemetry.values()]
        return {
            "pictures_per_second": round(1e3 / float(np.mean(periods)), 1),
            "picture_period": percentiles(periods),
            "processor_time_per_picture": round(processor, 1),
            "ticks": len(ticks),
            "ticks_not_seen": round(ticks[-1] - ticks[0]) + 1 - len(ticks),
            "driving": round(float(np.mean(driving)), 3),
            "lateness": percentiles(late),
        }


def main(options: Options) -> None:
    os.environ["SDL_VIDEODRIVER"] = "dummy"
    player = Player(options.seconds)
    controllers = {"rl": PolicyController(BROKK_170, load_policy(POLICY, BROKK_170))}
    no_attempts = Path(os.devnull).with_name("no attempts")
    play.play(BROKK_170, controllers, BusOptions(), no_attempts, player)
    write({"seconds": options.seconds, **player.figures()}, options.json)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
