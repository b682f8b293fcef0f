"""The window at 60 pictures a second and the 20 Hz loop beside it: pictures a second, lateness, lost ticks.

    python -m benchmarks.play [--seconds 20] [--json F]

The window is SDL's dummy one, keys are pressed through its queue; a policy drives the simulated machine. Its
weights are random, which costs the same time as trained ones.
"""

from __future__ import annotations

import json
import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from benchmarks.bus import random_policy
from brokk_min.can.drive_log import Telemetry
from brokk_min.learning.policy import PolicyController
from brokk_min.machine import BROKK_170
from brokk_min.viewer import input_handler, play
from brokk_min.viewer.control_process import BusOptions


@dataclass
class Options:
    seconds: float = 20.0
    """How long to drive [s]."""
    json: Path | None = None
    """Also write the figures here."""


class Player:
    """Holds the switch once the gate is ready, changes direction every second, and keeps times."""

    def __init__(self, seconds: float) -> None:
        self.seconds, self.begun, self.keys = seconds, 0.0, set[str]()
        self.times: list[float] = []
        self.known: dict[float, Telemetry] = {}

    def __call__(self, session: play.Session, hands: input_handler.InputHandler) -> bool:
        """One picture; False at the end."""
        now, known = time.monotonic(), session.telemetry
        if known is None:
            return True
        self.begun = self.begun or now * known.driving
        wanted = {"space"} if known.driving or not known.active_fault else set()
        if self.begun:
            self.times.append(now)
            self.known[known.tick] = known
            wanted |= {("left", "w", "right", "s")[int(now) % 4]}
        for name in self.keys ^ wanted:
            kind = hands.pygame.KEYDOWN if name in wanted else hands.pygame.KEYUP
            hands.pygame.event.post(
                hands.pygame.event.Event(kind, key=hands.pygame.key.key_code(name))
            )
        self.keys = wanted
        return not self.begun or now - self.begun < self.seconds


def figures(player: Player) -> dict[str, Any]:
    """Pictures a second and times in ms."""
    periods, ticks = 1e3 * np.diff(player.times), sorted(player.known)
    late = 1e3 * np.array([player.known[tick].lateness for tick in ticks])

    def spread(values: Any) -> dict[str, float]:
        return {f"p{p}": round(float(np.percentile(values, p)), 2) for p in (50, 99, 100)}

    return {
        "pictures_per_second": round(1e3 / float(np.mean(periods)), 1),
        "picture_period": spread(periods),
        "ticks": len(ticks),
        "ticks_not_seen": round(ticks[-1] - ticks[0]) + 1 - len(ticks),
        "driving": round(float(np.mean([k.driving for k in player.known.values()])), 3),
        "lateness": spread(late),
    }


def main(options: Options) -> None:
    os.environ["SDL_VIDEODRIVER"] = "dummy"
    player = Player(options.seconds)
    policy = PolicyController(BROKK_170, random_policy(np.random.default_rng(0)))
    attempts = Path(os.devnull).with_name("no attempts")
    play.play(BROKK_170, {"rl": policy}, BusOptions(), attempts, player)
    result = {"seconds": options.seconds, **figures(player)}
    print(json.dumps(result, indent=1))
    if options.json:
        options.json.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
