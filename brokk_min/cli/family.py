"""The command that runs the method on a family of machines."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from brokk_min.cli.options import Command, Range


@dataclass(kw_only=True)
class Family(Command):
    """Draw machines with physics of their own; run the chain on each, and each policy on all."""

    out: Path = Path("family")  # Folder for a folder of each member, and family.json.
    members: Annotated[int, Range(1, 1000)] = 8  # How many, from --seed on; finished ones stay.
    quick: bool = False  # The same, smaller: to see that it runs, not to assess the policies.

    def __call__(self) -> None:
        from brokk_min.evaluation.family import FAMILY, QUICK, run_family, show

        machine = self.check({self.out / "family.json": "family"})
        seeds = range(self.seed, self.seed + self.members)
        results = run_family(machine, seeds, self.out, QUICK if self.quick else FAMILY)
        print(show(results))
        print(self.out / "family.json")
